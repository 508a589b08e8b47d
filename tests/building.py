"""Builds what users get: wheels, and kernels that the address sanitizer watches."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "sb3_sparse" / "engine" / "native"
NEEDS_COMPILER = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="needs gcc (apt install gcc) for its address sanitizer"
)


def compile_watched(library: Path) -> None:
    """Compile kernels that the address sanitizer watches."""
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    hook.compile_kernels(SOURCES, library, ("-fsanitize=address", "-g", "-O0"))


def run_watched(program: Path, library: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program on kernels that the address sanitizer watches."""
    runtime = subprocess.run(
        ["gcc", "-print-file-name=libasan.so"], check=True, capture_output=True, text=True
    ).stdout.strip()
    return subprocess.run(
        [sys.executable, str(program), str(library), *arguments],
        env={**os.environ, "LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0",
             "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
        capture_output=True, text=True,
    )  # fmt: skip


def built_wheel(folder: Path, **environment: str) -> tuple[Path, str]:
    """Build a wheel in a copy of the sources; the wheel, and what was said."""
    source = folder / "source"
    for name in ("pyproject.toml", "README.md", "LICENSE", "hatch_build.py"):
        source.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "zoo_hparams", source / "zoo_hparams")
    shutil.copytree(ROOT / "sb3_sparse", source / "sb3_sparse")
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=source, env={**os.environ, **environment}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel, done.stdout + done.stderr
