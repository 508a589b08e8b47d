"""The stock zoo's own commands with our configs, unchanged."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from building import built_wheel
from stable_baselines3 import DQN, PPO, SAC
from zoo_support import run_zoo

ROOT = Path(__file__).parent.parent.parent
CONFIGS = ROOT / "zoo_hparams"


def training(algo: str, env: str, config: Path, steps: int, *args: str) -> list[str]:
    """A command of the zoo that trains."""
    options = ["--algo", algo, "--env", env, "--conf-file", str(config), "-n", str(steps)]
    return ["train", *options, "--eval-freq", "200", "--eval-episodes", "1", "--seed", "1", *args]


def enjoying(algo: str, env: str, *args: str) -> list[str]:
    """A command of the zoo that plays what was trained."""
    return ["enjoy", "--algo", algo, "--env", env, "-f", "logs", "--no-render", *args]


def series() -> dict[str, list[list[str]]]:
    """What the tests need, by the names of folders."""
    rigl, game = CONFIGS / "rigl", "PongNoFrameskip-v4"
    agent = ["-i", "logs/sac/Pendulum-v1_1/Pendulum-v1.zip"]
    kwargs = "policy_kwargs:dict(sparsity=0.5,net_arch=[32],distribution='uniform')"
    few = ["--hyperparams", "learning_starts:8", "buffer_size:100", "--eval-freq", "-1"]
    return {
        "sac": [
            training(
                "sac", "Pendulum-v1", rigl / "sac.yml", 150,
                "--save-freq", "120", "--save-replay-buffer",
            ),
            training("sac", "Pendulum-v1", rigl / "sac.yml", 130, *agent),
            enjoying("sac", "Pendulum-v1", "-n", "250"),
        ],
        "dqn": [
            training(
                "dqn", "CartPole-v1", CONFIGS / "set" / "dqn.yml", 60,
                "--hyperparams", kwargs, "learning_starts:10", "learning_rate:1e-4",
            )
        ],
        "ppo": [
            training(
                "ppo", "Hopper-v5", CONFIGS / "prune" / "ppo.yml", 400,
                "--vec-env", "subproc", "--hyperparams", "n_envs:2", "n_steps:64",
            ),
            enjoying("ppo", "Hopper-v5", "-n", "50", "--load-best"),
        ],
        "dicts": [
            training(
                "dqn", "TinyDicts-v0", rigl / "dqn.yml", 60,
                "--gym-packages", "dict_task", "--hyperparams", "learning_starts:20",
                "batch_size:8",
            )
        ],
        "nature": [training("dqn", game, rigl / "dqn.yml", 24, *few)],
        "impala": [training("dqn", game, rigl / "dqn_impala.yml", 24, *few)],
    }  # fmt: skip


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Folder of the folders in which the zoo's commands ran."""
    return tmp_path_factory.mktemp("zoo")


@pytest.fixture(scope="module")
def ends(logs):
    """How the zoo's commands ended."""
    return run_zoo(logs, series())


@pytest.fixture
def runs(logs, ends):
    """The runs that a series of commands left behind."""

    def of(name: str, algo: str) -> list[Path]:
        assert ends[name].error is None
        return sorted((logs / name / "logs" / algo).glob("*-v*_*"))

    return of


def assert_sparse(model, sparsity: float = 0.9) -> None:
    assert abs(model.policy.sparse.sparsity - sparsity) < 0.01
    for layer in model.policy.sparse.layers:
        assert layer.nnz == layer.final_nnz
        assert not layer.dense()[~layer.mask()].any()


def test_sac_trains_saves_checkpoints_goes_on_and_can_be_enjoyed(runs, ends):
    run, again = runs("sac", "sac")
    model = SAC.load(run / "Pendulum-v1.zip")
    assert model.num_timesteps == 150
    assert_sparse(model)
    assert_sparse(SAC.load(run / "rl_model_120_steps.zip"))
    clocks = [network.clock for network in model.policy.sparse.networks]
    masks = {layer.name: layer.mask().copy() for layer in model.policy.sparse.layers}

    resumed = SAC.load(again / "Pendulum-v1.zip")
    assert_sparse(resumed)
    assert all(n.clock > c for n, c in zip(resumed.policy.sparse.networks, clocks, strict=True))
    for layer in resumed.policy.sparse.layers:  # too short for an update
        assert (layer.mask() == masks[layer.name]).all()

    assert "Episode Reward" in ends["sac"].said


def test_dqn_takes_hyperparameters_from_the_command_line(runs):
    (run,) = runs("dqn", "dqn")
    model = DQN.load(run / "CartPole-v1.zip")
    assert_sparse(model, 0.5)
    assert [layer.shape for layer in model.policy.sparse.layers] == [(32, 4), (2, 32)]
    assert model.learning_rate(1.0) == 1e-4


def test_ppo_normalizes_in_several_processes(runs):
    (run,) = runs("ppo", "ppo")
    assert (run / "Hopper-v5" / "vecnormalize.pkl").is_file()
    model = PPO.load(run / "Hopper-v5.zip")
    assert model.n_envs == 2
    assert_sparse(model)


def test_dict_observations(runs):
    (run,) = runs("dicts", "dqn")
    model = DQN.load(run / "TinyDicts-v0.zip")
    assert_sparse(model)
    assert any(len(layer.shape) == 4 for layer in model.policy.sparse.layers)


@pytest.mark.parametrize("name", ["nature", "impala"])
def test_an_atari_game(name, runs):
    (run,) = runs(name, "dqn")
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
    command = [sys.executable, "-m", "rl_zoo3.train", *options, "--eval-freq", "25"]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)
    (log,) = (tmp_path / "logs" / "dqn" / "CartPole-v1_1").glob("evaluations.npz")
    assert np.load(log)["timesteps"].tolist() == [25, 50]
