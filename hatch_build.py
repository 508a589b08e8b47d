"""Build hook: compiles the sparse kernels into one library that no Python version is tied to.

Without a C compiler the package is built all the same, without the library.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags

NATIVE = Path("sb3_sparse", "engine", "native")
LIBRARY = NATIVE / "kernels.so"
FLAGS = [
    "-std=gnu11",
    "-O3",
    "-ffp-contract=fast",
    "-fPIC",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
]
SOURCES = ("kernels", "act", "fused", "images", "one_image")
"""Files that are compiled once for each instruction set."""
AVX2 = ["-mavx2", "-mfma"]
AVX512 = [*AVX2, "-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw"]


def compiler() -> list[str] | None:
    """The C compiler's command: ``CC``, else the first that is there."""
    if os.environ.get("CC"):
        return shlex.split(os.environ["CC"])
    found = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    return None if found is None else [found]


def this_platform() -> str:
    """The platform in a wheel's name: of this machine, with no claim about other distributions.

    Python's ``sysconfig`` may say "universal2" on a Mac, where the compiler builds for one
    processor.
    """
    return next(tag for tag in platform_tags() if not tag.startswith(("manylinux", "musllinux")))


def compile_kernels(source: Path, library: Path, extra: tuple[str, ...] = ()) -> None:
    """Compile the C files of ``source`` into ``library``.

    :param extra: further flags, e.g. ``-fsanitize=address``
    :raises OSError: if there is no compiler
    :raises subprocess.CalledProcessError: if it fails
    """
    command = compiler()
    if command is None:
        raise OSError("no C compiler (cc, gcc or clang) was found, and CC is not set")
    variants: dict[str, list[str]] = {"plain": []}
    if platform.machine().lower() in ("x86_64", "amd64"):
        variants.update(avx2=AVX2, avx512=AVX512)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:

        def compiled(name: str, suffix: str) -> str:
            made = str(Path(folder, f"{name}_{suffix}.o"))
            subprocess.run(
                [*command, *FLAGS, *variants[suffix], *extra, f"-DSUFFIX={suffix}", "-c",
                 str(source / f"{name}.c"), "-o", made],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
            return made

        with ThreadPoolExecutor(os.cpu_count()) as pool:  # each waits for a process of its own
            objects = list(pool.map(compiled, *zip(*product(SOURCES, variants), strict=True)))
        made = Path(folder, library.name)
        subprocess.run(
            [*command, *FLAGS, *extra, "-shared", str(source / "dispatch.c"), *objects, "-o",
             str(made), "-pthread", "-lm"],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        made.replace(library)  # at once: a running process keeps the old one


class KernelsHook(BuildHookInterface[Any]):
    """Compiles beside the sources, so that editable installs find the library too."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """As in hatchling: called before the wheel is put together."""
        root = Path(self.root)
        library = root / LIBRARY
        try:
            compile_kernels(root / NATIVE, library)
        except (OSError, subprocess.CalledProcessError) as error:
            library.unlink(missing_ok=True)  # of an earlier build
            reason = getattr(error, "stderr", None) or str(error)
            self.app.display_warning(
                "sb3_sparse: the sparse kernels were not compiled, so policies compute with masks "
                f"(compute='sparse' will say so): {reason}"
            )
            return
        build_data["artifacts"].append(LIBRARY.as_posix())
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{this_platform()}"


if __name__ == "__main__":  # python hatch_build.py: compile in place, for work on the C code
    here = Path(__file__).parent
    try:
        compile_kernels(here / NATIVE, here / LIBRARY, tuple(sys.argv[1:]))
    except subprocess.CalledProcessError as error:
        sys.exit(error.stderr)
