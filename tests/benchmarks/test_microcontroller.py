"""The benchmark of microcontrollers: what it counts."""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"


@pytest.mark.skipif(
    any(shutil.which(name) is None for name in ("arm-none-eabi-gcc", "qemu-system-arm", "make")),
    reason="needs arm-none-eabi-gcc, qemu-system-arm and make: apt-get install gcc-arm-none-eabi "
    "libnewlib-arm-none-eabi qemu-system-arm make",
)
def test_sparse_policies_take_fewer_instructions_and_bytes(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import microcontroller

    out = tmp_path / "found.csv"
    words = ["--sizes", "4-32-32-2", "--sparsities", "0,90", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["microcontroller.py", *words])
    microcontroller.main()
    rows = list(csv.DictReader(out.open()))
    kinds = ("float", "int8", "int8 full")
    variants = [("dense loop", ""), *((kind, percent) for percent in ("0", "90") for kind in kinds)]
    for board in ("m4f", "m0"):
        here = {(row["variant"], row["sparsity"]): row for row in rows if row["board"] == board}
        assert list(here) == variants
        weights = 4 * (4 * 32 + 32 * 32 + 32 * 2 + 32 + 32 + 2)
        dense, sparse = here["dense loop", ""], here["float", "90"]
        assert weights < int(dense["flash"]) < weights + 500
        assert dense["ram"] == str(4 * (32 + 32))
        assert int(dense["instructions"]) > 4 * (4 * 32 + 32 * 32 + 32 * 2)
        assert float(sparse["fewer"]) > 3
        assert float(sparse["smaller"]) > 3
        assert int(here["int8", "0"]["flash"]) < int(here["float", "0"]["flash"]) / 2
        whole, floats = here["int8 full", "0"], here["float", "0"]
        assert int(whole["ram"]) < int(floats["ram"])
        if board == "m0":  # which has no float unit
            assert int(whole["instructions"]) < int(floats["instructions"]) / 4
