"""The examples run, with small budgets."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"
BUDGETS = {
    "sac_rigl_mujoco.py": ["--steps", "1200"],
    "ppo_pruning.py": ["--steps", "3000"],
    "dqn_set.py": ["--steps", "2000"],
    "run_from_config.py": ["--steps", "2000"],
    "sparsify_checkpoint.py": ["--steps", "2000"],
    "deploy_c.py": ["--steps", "1500", "--episodes", "2"],
    "tune.py": ["--steps", "2000", "--trials", "2", "--workers", "1"],
}


TOUR = "tour.py"  # a notebook takes no options


def test_every_example_is_tried():
    assert {path.name for path in EXAMPLES.glob("*.py")} == {*BUDGETS, TOUR}


@pytest.mark.parametrize("name", sorted(BUDGETS))
def test_example(name, tmp_path):
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *BUDGETS[name]],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "return " in done.stdout
    assert "sparsity:" in done.stdout or name == "tune.py"


def test_the_tour_shows_what_it_says(tmp_path):
    code = (EXAMPLES / TOUR).read_text()
    for old, new in (("STEPS = 5000", "STEPS = 600"), ("EPISODES = 20", "EPISODES = 1")):
        assert code.count(old) == 1
        code = code.replace(old, new)
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "sparsity:" in done.stdout
    counts = [int(n.replace(",", "")) for n in re.findall(r"with (\S+) parameters", done.stdout)]
    dense, static, rigl, sparser = counts
    assert dense > 9 * static > 0
    assert static == rigl > 3 * sparser
    assert 0 < int(re.findall(r"RigL has moved (\d+)%", done.stdout)[0]) < 100
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
