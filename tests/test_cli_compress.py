"""``sb3-sparse compress`` as a user types it."""

from __future__ import annotations

import io
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, unwrap_vec_normalize
from support import make
from typer.testing import CliRunner

from sb3_sparse.cli import app
from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.saved import SavedModel

QUICK = ["--steps", "64", "--eval-episodes", "4"]


def sb3_sparse(*args: object) -> str:
    """What a command prints; its error is raised."""
    done = CliRunner().invoke(app, [str(arg) for arg in args], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture
def run(tmp_path) -> Path:
    """A run as rl-zoo leaves it: stock PPO, normalised and stacked."""
    folder = tmp_path / "ppo" / "CartPole-v1_1"
    params = folder / "CartPole-v1"
    params.mkdir(parents=True)
    env = VecNormalize(make_vec_env("CartPole-v1", n_envs=2, seed=0), gamma=0.9)
    model = make("PPO", env=VecFrameStack(env, 3), policy="MlpPolicy").learn(64)
    model.save(folder / "CartPole-v1.zip")
    env.save(str(params / "vecnormalize.pkl"))
    config = dict(normalize=True, frame_stack=3, n_envs=2, policy="MlpPolicy", n_timesteps=64.0)
    (params / "config.yml").write_text(yaml.dump(config))
    arguments = dict(algo="ppo", env="CartPole-v1", env_kwargs=None, seed=0)
    (params / "args.yml").write_text(yaml.dump(arguments))
    return folder


def test_a_stock_run_becomes_a_run_that_enjoy_and_inspect_read(run):
    said = sb3_sparse("compress", run, "--sparsity", "0.7", *QUICK)
    out = run.parent / "CartPole-v1_1-compressed-0.7"
    assert f"(PPO on CartPole-v1) into {out}" in said
    assert len(re.findall(r"^Level \d: sparsity", said, re.MULTILINE)) == 3
    assert "sparsity: actor 70.00%, critic 0.00%" in said
    assert re.search(r"connections of the actor: 912 before, 27\d now", said)  # 12-24-24-2
    outcome = out / "CartPole-v1.zip"
    model = PPO.load(outcome, device="cpu")
    assert model.policy.sparse.networks[0].nnz == pytest.approx(0.3 * 912, abs=3)
    assert f"sb3-sparse enjoy {out}" in said
    assert "Return over 3 episodes:" in sb3_sparse("enjoy", out, "-n", "3")
    assert re.search(
        r"sparsity: actor 0\.(69|70)\d+, critic 0.0000", sb3_sparse("inspect", outcome)
    )
    assert "is finished" in sb3_sparse("compress", run, "--sparsity", "0.7", *QUICK)
    # and once more from there: what is given goes down from what it has
    said = sb3_sparse("compress", out, "--sparsity", "0.8", *QUICK, "--out", run.parent / "next")
    assert "sparsity: actor 80.00%, critic 0.00%" in said


def test_environments_are_those_of_the_run(run):
    saved = SavedModel.find(run)
    training, evaluation = saved.training_envs(None, 0), saved.evaluation_envs(4, 0)
    assert (training.num_envs, evaluation.num_envs) == (2, 4)
    assert training.observation_space.shape == evaluation.observation_space.shape == (12,)
    ours, theirs = unwrap_vec_normalize(training), unwrap_vec_normalize(evaluation)
    assert (ours.training, ours.norm_reward, ours.gamma) == (True, True, 0.9)
    assert (theirs.training, theirs.norm_reward) == (False, False)
    np.testing.assert_array_equal(ours.obs_rms.mean, theirs.obs_rms.mean)
    assert ours.obs_rms.count > 64
    with pytest.raises(ConfigError, match="n_envs must be 1 or more, got 0"):
        saved.training_envs(0, 0)


def test_a_lone_zip_needs_its_environment_and_statistics(run, tmp_path):
    plain = tmp_path / "plain"
    make("PPO", env="CartPole-v1", policy="MlpPolicy").save(plain)
    with pytest.raises(ConfigError, match=r"does not name its environment; give --env"):
        sb3_sparse("compress", plain)
    with pytest.raises(ConfigError, match="did you mean 'CartPole-v1'"):
        sb3_sparse("compress", plain, "--env", "CartPool-v1")
    with pytest.raises(
        ConfigError, match="does not suit Pendulum-v1: Observation spaces do not match"
    ):
        sb3_sparse("compress", plain, "--env", "Pendulum-v1")
    sb3_sparse("compress", plain, "--env", "CartPole-v1", "--sparsity", "0.4", *QUICK)
    assert "Return over 2" in sb3_sparse("enjoy", tmp_path / "plain-compressed-0.4", "-n", "2")

    env = VecNormalize(make_vec_env("CartPole-v1"))
    make("PPO", env=env, policy="MlpPolicy").learn(32).save(tmp_path / "scaled")
    shutil.copy(run / "CartPole-v1" / "vecnormalize.pkl", tmp_path / "statistics.pkl")
    given = ["--env", "CartPole-v1", "--vecnormalize", tmp_path / "statistics.pkl"]
    out = tmp_path / "out"
    sb3_sparse(
        "compress", tmp_path / "scaled.zip", *given, "--sparsity", "0.4", "--out", out, *QUICK
    )
    assert (out / "CartPole-v1" / "vecnormalize.pkl").is_file()
    assert "Return over 2" in sb3_sparse("enjoy", out, "-n", "2")


class Interrupted(io.BytesIO):
    """A file at whose third write Ctrl-C is pressed."""

    writes = 0

    def write(self, data):
        self.writes += 1
        if self.writes == 3:
            raise KeyboardInterrupt
        return super().write(data)


def test_an_interrupt_while_torch_writes_is_one(run, monkeypatch):
    """Torch raises a RuntimeError about the file."""

    def compress(*_, **__):
        th.save({"weight": th.zeros(500)}, Interrupted())

    monkeypatch.setattr("sb3_sparse.compress.compress_model", compress)
    done = CliRunner().invoke(app, ["compress", str(run), "--sparsity", "0.7"])
    assert done.exit_code == 130
    assert "Interrupted. Finished levels are kept" in done.output


def test_an_interrupted_compression_goes_on(run):
    args = ["compress", str(run), "--sparsity", "0.7", "--steps", "640", "--eval-episodes", "4"]
    code = "from sb3_sparse.cli import main; main()"
    running = subprocess.Popen(
        [sys.executable, "-c", code, *args], stdout=subprocess.PIPE, text=True
    )
    state = run.parent / "CartPole-v1_1-compressed-0.7" / "compress.json"
    while not (state.is_file() and json.loads(state.read_text())["levels"]):
        assert running.poll() is None, "it ended before its first level"
        time.sleep(0.02)
    running.send_signal(signal.SIGINT)
    said, _ = running.communicate(timeout=60)
    assert running.returncode == 130, said
    assert "Interrupted. Finished levels are kept; give the same command to resume." in said
    said = sb3_sparse(*args)
    assert "Resuming after level" in said
    assert "Level 1:" not in said
    assert "Level 3:" in said
