"""Loads the compiled kernels."""

from __future__ import annotations

import ctypes
import struct
from functools import cache
from pathlib import Path
from typing import Any

import torch as th

from sb3_sparse.errors import ConfigError, MissingKernels

PATH = Path(__file__).with_name("kernels.so")
VERSION = 14
"""Version of the interface; ``dispatch.c`` has the same number."""


def _integers(names: str) -> list[tuple[str, type[ctypes.c_int64]]]:
    return [(name, ctypes.c_int64) for name in names.split()]


class LayerArgument(ctypes.Structure):
    """``layer_t`` of ``kernels.h``."""

    _fields_ = [
        *_integers("rows columns activation"),
        ("a", ctypes.c_double),
        ("b", ctypes.c_double),
        *_integers("row_start column column_start row position value bias output"),
        *_integers("value_grad bias_grad output_grad"),
    ]


class BatchArgument(ctypes.Structure):
    """``batch_t`` of ``kernels.h``."""

    _fields_ = [
        *_integers("layers batch threads input rows_in rows_out"),
        *_integers("rows_grad tiles_grad rows_input_grad tiles_input_grad"),
    ]


class MapArgument(ctypes.Structure):
    """``map_t`` of ``images.h``."""

    _fields_ = _integers("channels height width kept at grad_at")


class ImageStepArgument(ctypes.Structure):
    """``image_step_t`` of ``images.h``."""

    _fields_ = [
        *_integers("kind input source output add copy gate adds slope"),
        *_integers("kernel_y kernel_x stride_y stride_x padding_y padding_x taken activation"),
        ("a", ctypes.c_double),
        ("b", ctypes.c_double),
        *_integers("row_start column column_start row position value bias"),
        *_integers("value_grad bias_grad output_grad"),
    ]


class ImagesArgument(ctypes.Structure):
    """``images_t`` of ``images.h``."""

    _fields_ = [
        *_integers("steps maps batch threads ring grad_ring kept_size scratch_size kept"),
        *_integers("images_in images_out images_out_grad images_in_grad"),
    ]


def bits_of(number: float) -> int:
    """Return a double as the integer of the same bits, for structures filled as integers."""
    found: int = struct.unpack("q", struct.pack("d", number))[0]
    return found


_INT, _LONG, _DOUBLE, _ADDRESS = ctypes.c_int, ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "act": (_INT, [_ADDRESS, _LONG, _LONG, _INT, _ADDRESS, _ADDRESS]),
    "fused": (_LONG, [_ADDRESS, _LONG, _LONG]),
    "clear": (None, [_ADDRESS, _ADDRESS, _LONG]),
    "gaussian": (_INT, [_LONG, _LONG, *(_ADDRESS,) * 4]),
    "box": (None, [_INT, _LONG, _LONG, *(_ADDRESS,) * 4]),
    "squashed": (_INT, [_LONG, _DOUBLE, _DOUBLE, *(_ADDRESS,) * 4]),
}
"""Types of the result and the arguments of the functions that take plain numbers and addresses."""


@cache
def library() -> ctypes.CDLL:
    """Load the library and select the best instruction set of this processor.

    :raises MissingKernels: if it was not compiled, or was compiled for another version
    """
    if ctypes.sizeof(ctypes.c_void_p) != 8:
        raise MissingKernels("this is a 32-bit Python")
    if not PATH.exists():
        raise MissingKernels(
            "they were not compiled when sb3-sparse was installed (no C compiler, or it failed)"
        )
    try:
        found = ctypes.CDLL(str(PATH))
        version = found.sb3_sparse_version()
    except (OSError, AttributeError) as error:
        raise MissingKernels(f"the library does not load ({error})") from error
    if version != VERSION:
        raise MissingKernels(f"the library has version {version}, this package {VERSION}")
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(found, f"sb3_sparse_{name}")
        function.restype, function.argtypes = result, arguments
    found.sb3_sparse_instructions.restype = ctypes.c_char_p
    _use(found, found.sb3_sparse_instructions(0).decode())
    _share_threads(found)
    return found


def _share_threads(found: ctypes.CDLL) -> None:
    """Make the kernels use torch's own OpenMP threads, if torch has OpenMP."""
    names = ("GOMP_parallel", "omp_get_thread_num", "omp_get_num_threads")
    folder = Path(th.__file__).parent / "lib"
    paths = [path for name in ("gomp", "iomp", "omp") for path in folder.glob(f"lib{name}*")]
    for path in [*map(str, paths), None]:  # None: what the process has loaded
        try:
            openmp = ctypes.CDLL(path)
            functions = [ctypes.cast(getattr(openmp, name), ctypes.c_void_p) for name in names]
        except (OSError, AttributeError):
            continue
        found.sb3_sparse_share_threads(*functions)
        return


def why_missing() -> str | None:
    """Tell why the kernels cannot run here; None if they can."""
    try:
        library()
    except MissingKernels as error:
        return error.reason
    return None


def readable(tensor: th.Tensor) -> bool:
    """Whether the kernels can read and write a tensor in place."""
    return tensor.dtype is th.float32 and tensor.is_cpu and tensor.is_contiguous()


def instruction_sets() -> list[str]:
    """List the instruction sets that run here, best first."""
    found = library()
    names: list[str] = []
    while (name := found.sb3_sparse_instructions(len(names))) is not None:
        names.append(name.decode())
    return names


_in_use = ""


def in_use() -> str:
    """Name the instruction set that the kernels use."""
    library()
    return _in_use


def use(name: str) -> None:
    """Select another instruction set, for tests and comparisons.

    :raises ConfigError: if the processor does not have it
    """
    if name not in instruction_sets():
        raise ConfigError(
            f"{name!r} does not run on this processor; these do: {', '.join(instruction_sets())}"
        )
    _use(library(), name)


def _use(found: ctypes.CDLL, name: str) -> None:
    global _in_use
    done = found.sb3_sparse_use(name.encode())
    assert done == 0
    _in_use = name
