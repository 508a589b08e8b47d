"""Fused gradient steps stay within their memory."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_sparse.engine.native import library

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The kernels, watched by the address sanitizer."""
    if shutil.which("gcc") is None:
        pytest.skip("needs gcc (apt install gcc) for its address sanitizer")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    path = tmp_path_factory.mktemp("watched") / "kernels.so"
    hook.compile_kernels(
        ROOT / "sb3_sparse" / "engine" / "native", path, ("-fsanitize=address", "-g", "-O1")
    )
    return path


@pytest.mark.parametrize("instructions", library.instruction_sets())
def test_fused_steps_stay_within_bounds_under_the_address_sanitizer(made, instructions):
    runtime = subprocess.run(
        ["gcc", "-print-file-name=libasan.so"], check=True, capture_output=True, text=True
    ).stdout.strip()

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, str(Path(__file__).with_name("bounds.py")), str(made), instructions,
             *arguments],
            env={**os.environ, "LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0",
                 "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
            capture_output=True, text=True,
        )  # fmt: skip

    done = run()
    assert done.stdout.split("\n")[-2:] == ["within bounds", ""], done.stderr[-3000:]
    assert "AddressSanitizer: heap-buffer-overflow" in run("broken").stderr
