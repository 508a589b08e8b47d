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
    variants = [("dense loop", ""), ("float", "0"), ("int8", "0"), ("float", "90"), ("int8", "90")]
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
