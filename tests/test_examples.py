"""The examples run, with small budgets."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import matplotlib
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"
BUDGETS = {
    "sac_rigl_mujoco.py": ["--env", "Hopper-v5", "--steps", "300"],
    "ppo_pruning.py": ["--steps", "3000"],
    "dqn_set.py": ["--steps", "2000"],
    "run_from_config.py": ["--steps", "256"],
    "sparsify_checkpoint.py": ["--steps", "500"],
    "deploy_c.py": ["--steps", "1500", "--episodes", "1"],
    "tune.py": ["--steps", "2000", "--trials", "1", "--workers", "1"],
}


TOUR = "tour.py"  # a notebook takes no options


def test_every_example_is_tried():
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*BUDGETS, TOUR}


@pytest.mark.parametrize("name", sorted(BUDGETS))
def test_example(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *BUDGETS[name]])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    said = capsys.readouterr().out
    assert "return " in said
    assert "sparsity:" in said or name == "tune.py"


def test_the_tour_shows_what_it_says(tmp_path, monkeypatch, capsys):
    code = (EXAMPLES / TOUR).read_text()
    for old, new in (
        ("STEPS = 5000", "STEPS = 320"),
        ("EPISODES = 20", "EPISODES = 1"),
        ("learning_starts=200", "learning_starts=100"),
        ("update_interval=200", "update_interval=100"),
    ):
        assert code.count(old) == 1
        code = code.replace(old, new)
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    exec(compile(code, TOUR, "exec"), {})
    said = capsys.readouterr().out
    assert "sparsity:" in said
    counts = [int(n.replace(",", "")) for n in re.findall(r"with (\S+) parameters", said)]
    dense, static, rigl, sparser = counts
    assert dense > 9 * static > 0
    assert static == rigl > 3 * sparser
    assert 0 < int(re.findall(r"RigL has moved (\d+)%", said)[0]) < 100
    drawn = {path.name for path in tmp_path.glob("*.png")}
    assert drawn == {"tour_learning.png", "tour_masks.png", "tour_parameters.png"}
    assert (tmp_path / "tour_policy.c").exists()


def test_the_cells_of_the_tour_are_a_notebook_s():
    cells = re.split(r"^# %%", (EXAMPLES / TOUR).read_text(), flags=re.MULTILINE)
    assert cells[0] == ""
    for cell in cells[1:]:
        title, _, body = cell.partition("\n")
        if title == " [markdown]":
            assert all(line.startswith("#") for line in body.split("\n") if line)
        else:
            assert title == ""
            compile(body, TOUR, "exec")
