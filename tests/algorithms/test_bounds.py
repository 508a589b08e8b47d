"""Fused gradient steps stay within their memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from building import NEEDS_COMPILER, run_watched

from sb3_sparse.engine.native import library

PROGRAM = Path(__file__).with_name("bounds.py")


@NEEDS_COMPILER
@pytest.mark.parametrize("instructions", library.instruction_sets())
def test_fused_steps_stay_within_bounds_under_the_address_sanitizer(watched_kernels, instructions):
    done = run_watched(PROGRAM, watched_kernels, instructions)
    assert done.stdout.split("\n")[-2:] == ["within bounds", ""], done.stderr[-3000:]
    broken = run_watched(PROGRAM, watched_kernels, instructions, "broken")
    assert "AddressSanitizer: heap-buffer-overflow" in broken.stderr
