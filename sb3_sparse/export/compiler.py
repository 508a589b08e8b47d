"""Compiles a policy in C, and calls it, for the check."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.c import CHECK, CHECKED
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.inexact import inexact_quantizations
from sb3_sparse.export.observations import Observations, count_of

COMPILERS = ("cc", "gcc", "clang")
OPTIONS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror")


@dataclass(frozen=True)
class Compiled:
    """A compiled policy; called with observations it returns all outputs, one row for each.

    :param graph: gives the sizes of observation and outputs
    :param library: has the function
    """

    graph: Graph
    library: ctypes.CDLL

    def __call__(self, observations: Observations) -> NDArray[np.float32]:
        """Return all outputs side by side in a row for each observation."""
        return self.outputs_and_numbers(observations)[0]

    def outputs_and_numbers(
        self, observations: Observations
    ) -> tuple[NDArray[np.float32], NDArray[np.int16]]:
        """Return the outputs, and the numbers of all inexact quantizations, rows of both."""
        pointer = ctypes.POINTER(ctypes.c_float)
        sizes = list(self.graph.sizes.values())
        starts = np.cumsum([0, *sizes[:-1]])
        function = self.library.sb3_sparse_policy
        function.argtypes, function.restype = [pointer] * (1 + len(sizes)), None
        rows = self.graph.rows(observations).reshape(count_of(observations), -1)
        outputs = np.empty((len(rows), sum(sizes)), np.float32)
        numbers = []
        for row, output in zip(np.ascontiguousarray(rows), outputs, strict=True):
            written = (output[start:].ctypes.data_as(pointer) for start in starts)
            function(row.ctypes.data_as(pointer), *written)
            numbers.append(self._numbers())
        return outputs, np.array(numbers, np.int16)

    def _numbers(self) -> NDArray[np.int16]:
        """Return the whole numbers that the floats of the latest observation became."""
        count = sum(int(np.prod(self.graph.shape_of(v))) for v in inexact_quantizations(self.graph))
        kept: Any = (ctypes.c_int16 * count).in_dll(self.library, CHECKED) if count else []
        return np.array(kept, np.int16)


def compiler() -> list[str]:
    """Return the command of a C compiler: ``$CC``, else cc, gcc or clang.

    :raises UnsupportedError: if there is none
    """
    try:
        command = shlex.split(os.environ.get("CC", ""))
    except ValueError as error:
        raise UnsupportedError(f"CC={os.environ['CC']!r} is not a command: {error}") from error
    names = [command[0]] if command else list(COMPILERS)
    for name in names:
        found = shutil.which(name)
        if found is not None:
            return [found, *command[1:]]
    raise UnsupportedError(
        f"a C export is compiled and run to check it, but there is no {' or '.join(names)} here; "
        "install gcc or clang, name a compiler in the environment variable CC, or write the export "
        "unchecked with force (--force)"
    )


def compiled(source: str, graph: Graph, options: tuple[str, ...] = OPTIONS) -> Compiled:
    """Compile a policy; return what calls it through ctypes.

    :param graph: the policy
    :raises UnsupportedError: if there is no compiler, or what it builds does not run
    """
    with tempfile.TemporaryDirectory() as folder:
        path, library = Path(folder) / "policy.c", Path(folder) / "policy.so"
        path.write_text(source)
        command = [*compiler(), *options, f"-D{CHECK}", "-shared", "-fPIC"]
        command += [str(path), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise UnsupportedError(
                f"{shlex.join(command[:1])} cannot compile the C export (exit code "
                f"{done.returncode}): {done.stderr.strip() or 'no message'}. Name another "
                "compiler in CC, or write it unchecked with force (--force)"
            )
        try:
            return Compiled(graph, ctypes.CDLL(str(library)))
        except OSError as error:
            raise UnsupportedError(
                f"what {shlex.join(compiler())} builds does not run here ({error}), so the C "
                "export cannot be checked; name a compiler for this machine in CC, or write it "
                "unchecked with force (--force)"
            ) from error
