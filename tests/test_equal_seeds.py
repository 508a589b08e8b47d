"""Equal seeds give equal runs, bit for bit, with nothing asked for but a sparsity."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from support import make

from sb3_sparse import SparsityCallback
from sb3_sparse.loading.zips import read_model
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

SMALL, LARGE = 24, 200
CASES = [(name, width) for name in ("DQN", "SAC", "PPO") for width in (SMALL, LARGE)]
RUN = RunSpec(
    algo="sac",
    env_id="Pendulum-v1",
    n_timesteps=120,
    hyperparams={"net_arch": [LARGE, LARGE], "learning_starts": 50, "update_interval": 20},
    eval_freq=60,
    eval_episodes=1,
)


def learned(name: str, width: int, seed: int = 0) -> BaseAlgorithm:
    """A model whose mask has moved; 90 % sparse, ``compute`` as by default."""
    env = "CartPole-v1" if name == "DQN" else "Pendulum-v1"
    kwargs = dict(sparsity=0.9, net_arch=[width, width])
    model = make(name, env, policy="SparsePolicy", policy_kwargs=kwargs, seed=seed)
    model.learn(64, callback=SparsityCallback("rigl", update_interval=4))
    return model


def digest(state: dict) -> str:
    """One text for a state_dict, to the bit."""
    found = hashlib.sha256()
    for name, value in state.items():
        found.update(name.encode())
        found.update(value.numpy().tobytes())
    return found.hexdigest()


def digest_of(model: BaseAlgorithm) -> str:
    return digest(model.policy.state_dict())


def digest_of_run(folder: Path) -> str:
    outcome = train(RUN, folder)
    _, state = read_model(outcome.folder / "Pendulum-v1.zip")
    return digest(state)


def digests(folder: Path) -> dict[str, str]:
    """Of all cases, and of a run of the command's."""
    found = {f"{name} {width}": digest_of(learned(name, width)) for name, width in CASES}
    return {**found, "run": digest_of_run(folder)}


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> dict[str, str]:
    return digests(tmp_path_factory.mktemp("first"))


@pytest.mark.parametrize(("name", "width"), CASES)
def test_two_models_of_one_process_are_equal(name, width, here):
    model = learned(name, width)
    assert model.policy.sparsity_config.compute == "auto"
    assert any(layer.is_sparse for layer in model.policy.sparse.layers) == (width == LARGE)
    assert digest_of(model) == here[f"{name} {width}"]
    assert digest_of(learned(name, width, seed=1)) != here[f"{name} {width}"]


def test_two_runs_of_one_process_are_equal(here, tmp_path):
    assert digest_of_run(tmp_path) == here["run"]


def test_models_and_runs_of_two_processes_are_equal(here, tmp_path):
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout.splitlines()[-1]) == here


if __name__ == "__main__":
    th.set_num_threads(1)  # as in conftest.py
    print(json.dumps(digests(Path(sys.argv[1]))))
