"""The stock zoo's own commands with our configs, unchanged, in a fresh process each."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from building import built_wheel
from stable_baselines3 import DQN, PPO, SAC

ROOT = Path(__file__).parent.parent.parent
CONFIGS = ROOT / "zoo_hparams"


def zoo(command: str, *args: str, cwd: Path, path: Path | None = None) -> str:
    """Run ``python -m rl_zoo3.<command>``; what it printed."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    environment["PYTHONPATH"] = str(path or ROOT / "tests")
    done = subprocess.run(
        [sys.executable, "-m", f"rl_zoo3.{command}", *args],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def train(algo: str, env: str, config: Path, steps: int, *args: str, cwd: Path) -> Path:
    """Train with the zoo; the run's folder."""
    options = ["--algo", algo, "--env", env, "--conf-file", str(config), "-n", str(steps)]
    evaluation = ["--eval-freq", "200", "--eval-episodes", "1", "--seed", "1"]
    zoo("train", *options, *evaluation, *args, cwd=cwd)
    runs = sorted((cwd / "logs" / algo).glob(f"{env}_*"))
    assert runs
    return runs[-1]


def assert_sparse(model, sparsity: float = 0.9) -> None:
    assert abs(model.policy.sparse.sparsity - sparsity) < 0.01
    for layer in model.policy.sparse.layers:
        assert layer.nnz == layer.final_nnz
        assert not layer.dense()[~layer.mask()].any()


def test_sac_trains_saves_checkpoints_goes_on_and_can_be_enjoyed(tmp_path):
    config = CONFIGS / "rigl" / "sac.yml"
    more = ["--save-freq", "150", "--save-replay-buffer"]
    run = train("sac", "Pendulum-v1", config, 300, *more, cwd=tmp_path)
    model = SAC.load(run / "Pendulum-v1.zip")
    assert model.num_timesteps == 300
    assert_sparse(model)
    assert_sparse(SAC.load(run / "rl_model_150_steps.zip"))
    clocks = [network.clock for network in model.policy.sparse.networks]
    masks = {layer.name: layer.mask().copy() for layer in model.policy.sparse.layers}

    agent = ["-i", str(run / "Pendulum-v1.zip")]
    again = train("sac", "Pendulum-v1", config, 200, *agent, cwd=tmp_path)
    assert again != run
    resumed = SAC.load(again / "Pendulum-v1.zip")
    assert_sparse(resumed)
    assert all(n.clock > c for n, c in zip(resumed.policy.sparse.networks, clocks, strict=True))
    for layer in resumed.policy.sparse.layers:  # too short for an update
        assert (layer.mask() == masks[layer.name]).all()

    said = zoo(
        "enjoy", "--algo", "sac", "--env", "Pendulum-v1", "-f", "logs", "--no-render", "-n", "250",
        cwd=tmp_path,
    )  # fmt: skip
    assert "Episode Reward" in said


def test_dqn_takes_hyperparameters_from_the_command_line(tmp_path):
    kwargs = "policy_kwargs:dict(sparsity=0.5,net_arch=[32],distribution='uniform')"
    more = ["--hyperparams", kwargs, "learning_starts:10", "learning_rate:1e-4"]
    run = train("dqn", "CartPole-v1", CONFIGS / "set" / "dqn.yml", 300, *more, cwd=tmp_path)
    model = DQN.load(run / "CartPole-v1.zip")
    assert_sparse(model, 0.5)
    assert [layer.shape for layer in model.policy.sparse.layers] == [(32, 4), (2, 32)]
    assert model.learning_rate(1.0) == 1e-4


def test_ppo_normalizes_in_several_processes(tmp_path):
    more = ["--vec-env", "subproc", "--hyperparams", "n_envs:2", "n_steps:64"]
    run = train("ppo", "Hopper-v5", CONFIGS / "prune" / "ppo.yml", 400, *more, cwd=tmp_path)
    assert (run / "Hopper-v5" / "vecnormalize.pkl").is_file()
    model = PPO.load(run / "Hopper-v5.zip")
    assert model.n_envs == 2
    assert_sparse(model)
    zoo(
        "enjoy", "--algo", "ppo", "--env", "Hopper-v5", "-f", "logs", "--no-render", "-n", "50",
        "--load-best",
        cwd=tmp_path,
    )  # fmt: skip


def test_dict_observations(tmp_path):
    more = ["--gym-packages", "dict_task", "--hyperparams", "learning_starts:20", "batch_size:8"]
    run = train("dqn", "TinyDicts-v0", CONFIGS / "rigl" / "dqn.yml", 60, *more, cwd=tmp_path)
    model = DQN.load(run / "TinyDicts-v0.zip")
    assert_sparse(model)
    assert any(len(layer.shape) == 4 for layer in model.policy.sparse.layers)


@pytest.mark.parametrize("name", ["dqn", "dqn_impala"])
def test_an_atari_game(name, tmp_path):
    more = ["--hyperparams", "learning_starts:8", "buffer_size:100", "--eval-freq", "-1"]
    config = CONFIGS / "rigl" / f"{name}.yml"
    run = train("dqn", "PongNoFrameskip-v4", config, 24, *more, cwd=tmp_path)
    model = DQN.load(run / "PongNoFrameskip-v4.zip")
    assert model.observation_space.shape == (4, 84, 84)
    assert model._n_updates == 4
    assert_sparse(model)


def test_the_wheel_carries_the_configs_and_the_zoo_runs_with_them(tmp_path):
    wheel, _ = built_wheel(tmp_path, CC="no-such-compiler")
    installed = tmp_path / "installed"
    subprocess.run([sys.executable, "-m", "zipfile", "-e", wheel, installed], check=True)
    code = "from sb3_sparse.zoo import config_path; print(config_path('static', 'dqn'))"
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    said = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    path = Path(said.stdout.strip())
    assert path.is_relative_to(installed)
    shipped = {p.relative_to(CONFIGS): p.read_bytes() for p in CONFIGS.rglob("*.yml")}
    root = path.parent.parent
    assert {p.relative_to(root): p.read_bytes() for p in root.rglob("*.yml")} == shipped
    options = ["--algo", "dqn", "--env", "CartPole-v1", "--conf-file", str(path), "-n", "50"]
    zoo("train", *options, "--eval-freq", "25", cwd=tmp_path, path=installed)
    (log,) = (tmp_path / "logs" / "dqn" / "CartPole-v1_1").glob("evaluations.npz")
    assert np.load(log)["timesteps"].tolist() == [25, 50]
