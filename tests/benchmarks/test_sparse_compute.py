"""The benchmark of sparse storage: what it says of the rule of ``compute="auto"``."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest

from sb3_sparse.engine.native.library import in_use, instruction_sets, use

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"


@pytest.fixture
def sparse_compute(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import sparse_compute

    before = in_use()
    yield sparse_compute
    use(before)


def row(variant: str, speedup: float, sparsity: float = 0.5) -> dict[str, object]:
    case = dict(what="rule", case="DQN 256 ReLU", batch=128, sparsity=sparsity)
    return dict(case, variant=variant, speedup=speedup)


def test_the_rule_is_behind_the_better_of_its_two_choices(sparse_compute, capsys):
    half = [row("masked", 1.0), row("sparse avx2", 1.5), row("auto avx2", 1.0)]
    near = [row("masked", 1.0, 0.9), row("sparse avx2", 2.0, 0.9), row("auto avx2", 1.95, 0.9)]
    slow = [row("masked", 1.0, 0.8), row("sparse avx2", 0.5, 0.8), row("auto avx2", 0.8, 0.8)]
    sparse_compute.print_rule([*half, *near, *slow, dict(half[1], what="step")])
    assert capsys.readouterr().out.splitlines() == [
        "2 of 3 cases in which auto is more than 5% behind",
        "  DQN 256 ReLU 50% avx2: auto 1.00x, sparse 1.50x of masked: 50.0% behind",
        "  DQN 256 ReLU 80% avx2: auto 0.80x, sparse 0.50x of masked: 25.0% behind",
    ]


def test_the_rule_is_measured_in_every_instruction_set(sparse_compute, monkeypatch, tmp_path):
    path = tmp_path / "rule.csv"
    grid = ["--algos", "DQN", "--widths", "16", "--sparsities", "0.9", "--activations", "Tanh"]
    words = ["sparse_compute.py", "--rule", *grid, "--rounds", "1", "--csv", str(path)]
    monkeypatch.setattr(sys, "argv", words)
    sparse_compute.main()
    with path.open(newline="") as file:
        rows = {one["variant"]: one for one in csv.DictReader(file)}
    sets = instruction_sets()
    named = [f"{name} {one}" for name in ("sparse", "auto") for one in sets]
    assert list(rows) == ["masked", *named]
    assert {one["case"] for one in rows.values()} == {"DQN 16 Tanh"}
    for one in sets:  # so small that auto keeps masks, and so is the same program
        assert rows[f"auto {one}"]["milliseconds"] == rows["masked"]["milliseconds"]
        assert rows[f"auto {one}"]["speedup"] == "1.0"
