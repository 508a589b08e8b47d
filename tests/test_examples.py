"""The examples run, with small budgets."""

from __future__ import annotations

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


def test_every_example_is_tried():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(BUDGETS)


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
