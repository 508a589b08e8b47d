"""Fused gradient steps stay within their memory."""

from __future__ import annotations

from pathlib import Path

from building import NEEDS_COMPILER, run_watched

from sb3_sparse.engine.native import library

PROGRAM = Path(__file__).with_name("bounds.py")


@NEEDS_COMPILER
def test_fused_steps_stay_within_bounds_under_the_address_sanitizer(watched_kernels):
    done = run_watched(PROGRAM, watched_kernels)
    sets = library.instruction_sets()
    assert done.stdout.splitlines() == [f"{one} is within bounds" for one in sets], done.stderr
    broken = run_watched(PROGRAM, watched_kernels, "broken")
    assert broken.stdout.splitlines() == [f"{one} fails" for one in sets]
    assert broken.stderr.count("ERROR: AddressSanitizer: heap-buffer-overflow") == len(sets)
