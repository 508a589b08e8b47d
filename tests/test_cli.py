"""The command line as a user types it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from stable_baselines3 import DQN, PPO


def sb3_sparse(*args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from sb3_sparse.cli import main; main()", *args]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def test_train_saves_evaluates_and_says_where_and_inspect_reads_it(tmp_path):
    done = sb3_sparse("train", "-n", "1500", "--seed", "3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Training DQN on CartPole-v1, rigl at 90% (ERK), seed 3" in done.stdout
    assert re.search(r"1500 of 1500 steps, return \d+\.\d, sparsity 90\.\d\d%", done.stdout)
    assert "Sparsity 90.00%. Return over 20 episodes:" in done.stdout
    folder = Path("logs") / "dqn" / "CartPole-v1_1"
    for what, name in (("Last policy", "CartPole-v1.zip"), ("Best checkpoint", "best_model.zip")):
        score = r":\s+\d+\.\d ± \d+\.\d  "
        assert re.search(what + score + re.escape(str(folder / name)), done.stdout)
    path = tmp_path / folder / "CartPole-v1.zip"
    assert DQN.load(path).num_timesteps == 1536  # whole rollouts of 256
    assert 1200 < DQN.load(path.with_name("best_model.zip")).num_timesteps <= 1536

    done = sb3_sparse("inspect", str(path.with_suffix("")), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # 4-256-256-2 at 90 %: 1024 + 65536 + 512 connections.
    assert re.search(r"q_net\.q_net\.2\s+256x256\s+5,173\s+0\.0789", done.stdout)
    assert re.search(r"total\s+6,709\s+0\.1000", done.stdout)


def test_options_and_a_second_run_beside_the_first(tmp_path):
    args = ["--algo", "ppo", "--env", "CartPole-v1", "--method", "prune", "--sparsity", "0.8"]
    args += ["--distribution", "uniform", "-n", "600", "--log-folder", "elsewhere"]
    for number in (1, 2):
        done = sb3_sparse("train", *args, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        path = tmp_path / "elsewhere" / "ppo" / f"CartPole-v1_{number}" / "CartPole-v1.zip"
        model = PPO.load(path)
    for layer in model.policy.sparse.layers:
        assert layer.nnz == layer.size - int(0.8 * layer.size + 1e-6)


def test_dense_is_stock_sb3_and_inspect_says_that_it_is_not_sparse(tmp_path):
    done = sb3_sparse("train", "--method", "dense", "-n", "600", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    path = tmp_path / "logs" / "dqn" / "CartPole-v1_1" / "CartPole-v1.zip"
    assert type(DQN.load(path).policy).__module__.startswith("stable_baselines3")
    done = sb3_sparse("inspect", str(path), cwd=tmp_path)
    assert done.returncode == 2
    assert "is not sparse but DQNPolicy" in done.stderr


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--algo", "dqnn"], "unknown algorithm 'dqnn'; allowed are dqn, sac, td3"),
        (["--env", "CartPool-v1"], "unknown environment 'CartPool-v1'"),
        (["--method", "riggle"], "unknown method 'riggle'; allowed are dense, "),
        (["--sparsity", "1.5"], "must lie in [0, 1)"),
        (["--distribution", "flat"], "allowed are er, erk, uniform"),
        (["-n", "0"], "must be 1 or more, got 0"),
        (["--algo", "sac"], "sac cannot act in CartPole-v1"),
        (["--env", "Pendulum-v1"], "dqn cannot act in Pendulum-v1"),
    ],
)
def test_mistakes_are_one_line_and_make_nothing(args, message, tmp_path):
    done = sb3_sparse("train", *args, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.rglob("*.zip"))


def test_inspect_of_what_is_no_model(tmp_path):
    (tmp_path / "notes.zip").write_text("no zip at all")
    for name, message in (("gone.zip", "there is no file"), ("notes.zip", "is no model saved by")):
        done = sb3_sparse("inspect", name, cwd=tmp_path)
        assert done.returncode == 2
        assert message in done.stderr


@pytest.mark.parametrize(
    ("missing", "code", "cure"),
    [
        ("typer", "import sb3_sparse.cli", "sb3-sparse[zoo]"),
        ("sb3_contrib", "import sb3_sparse; sb3_sparse.SparseTQCPolicy", "sb3-sparse[contrib]"),
    ],
)
def test_a_missing_extra_names_its_cure(missing, code, cure, tmp_path):
    script = f"import sys; sys.modules[{missing!r}] = None\n{code}"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert cure in done.stderr


def test_the_core_works_without_any_extra(tmp_path):
    missing = ["sb3_contrib", "typer", "rich", "tqdm", "rl_zoo3", "optuna", "mujoco", "pandas"]
    script = (
        f"import sys; [sys.modules.__setitem__(name, None) for name in {missing}]\n"
        "import sb3_sparse\n"
        "from stable_baselines3 import PPO\n"
        "model = PPO('SparsePolicy', 'CartPole-v1', n_steps=16, batch_size=16,"
        " policy_kwargs=dict(sparsity=0.9))\n"
        "model.learn(16, callback=sb3_sparse.SparsityCallback('rigl'))\n"
        "assert 'TQC' not in sb3_sparse.supported_algorithms()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
