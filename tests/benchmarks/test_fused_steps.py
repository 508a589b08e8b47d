"""The benchmark of gradient steps alone: what it compares, and what it refuses to call fused."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import sb3_sparse

BENCHMARKS = Path(__file__).parent.parent.parent / "benchmarks"


@pytest.fixture
def fused_steps(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import fused_steps

    return fused_steps


def test_a_case_is_a_line_for_each_way(fused_steps, monkeypatch, capsys):
    monkeypatch.setattr(fused_steps, "CASES", {"PPO 8": fused_steps.Case("PPO", 8, 8)})
    monkeypatch.setattr(fused_steps, "STEPS", 2)
    words = ["--sparsity", "0.5", "--rounds", "1"]
    monkeypatch.setattr(sys, "argv", ["fused_steps.py", *words])
    fused_steps.main()
    _, _, *lines = capsys.readouterr().out.splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [row[:3] for row in cells] == [
        ["PPO 8", "50%", way] for way in ("stock", "plug-in", "fused")
    ]
    milliseconds = [float(row[3]) for row in cells]
    for row, took in zip(cells, milliseconds, strict=True):
        assert took > 0
        # All numbers are rounded to three digits behind the point, of which small ones have few.
        assert float(row[4]) == pytest.approx(took / milliseconds[0], rel=0.1)
        assert float(row[5]) == pytest.approx(took / milliseconds[1], rel=0.1)


def test_steps_that_are_not_fused_are_not_called_so(fused_steps, monkeypatch):
    monkeypatch.setattr(fused_steps, "STEPS", 1)
    monkeypatch.setattr(sb3_sparse.DQN, "why_not_fused", lambda model: "a reason")
    with pytest.raises(SystemExit, match="SB3's own: a reason"):
        fused_steps.time_case(fused_steps.Case("DQN", 8, 8), 0.5, 1)


def test_no_case_at_all_is_rejected(fused_steps, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["fused_steps.py", "--cases", "SACK"])
    with pytest.raises(SystemExit):
        fused_steps.main()
    assert "contains 'SACK'" in capsys.readouterr().err
