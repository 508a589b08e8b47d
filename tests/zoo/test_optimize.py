"""rl-zoo's own hyperparameter search trains with the sparsity of the config."""

from __future__ import annotations

import subprocess
import sys

import pytest
from stable_baselines3 import DQN, PPO, SAC

ENVS = {"dqn": "CartPole-v1", "sac": "Pendulum-v1", "ppo": "CartPole-v1"}
CLASSES = {"dqn": DQN, "sac": SAC, "ppo": PPO}
CONFIG = """
{env}:
  n_timesteps: 120
  policy: sb3_sparse.SparsePolicy
  policy_kwargs:
    sparsity: 0.3
    distribution: uniform
    net_arch: [17]
  callback:
    - sb3_sparse.SparsityCallback:
        method: rigl
        update_interval: 5
"""


def optimize(algo, config, cwd, *more):
    (cwd / "config.yml").write_text(config)
    command = [
        sys.executable, "-m", "rl_zoo3.train", "--algo", algo, "--env", ENVS[algo],
        "--conf-file", "config.yml", "-optimize", "--n-trials", "2", "--n-evaluations", "1",
        "--eval-episodes", "1", "-n", "120", "--no-optim-plots", "--seed", "1",
        "--optimization-log-path", "trials", *more,
    ]  # fmt: skip
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("algo", sorted(ENVS))
def test_each_trial_trains_with_the_configs_sparsity(algo, tmp_path):
    config = CONFIG.format(env=ENVS[algo])
    done = optimize(algo, config, tmp_path, "--gym-packages", "sb3_sparse.rl_zoo_optimize")
    assert done.returncode == 0, done.stderr
    models = sorted(tmp_path.glob("trials/trial_*/best_model.zip"))
    assert len(models) == 2
    for path in models:
        policy = CLASSES[algo].load(path).policy
        report = policy.sparsity_report()
        assert policy.sparsity_config.distribution == "uniform"
        for layer in report.layers:
            assert layer.size - layer.nnz == int(0.3 * layer.size)  # zeros, by section 2
        widths = {layer.shape[0] for layer in report.layers}
        assert 17 not in widths  # the width is the sampler's, as in rl-zoo


def test_without_it_the_sparsity_is_missed_and_a_stock_policy_is_left_alone(tmp_path):
    config = CONFIG.format(env="CartPole-v1")
    done = optimize("dqn", config, tmp_path, "--gym-packages", "sb3_sparse.zoo")
    assert done.returncode != 0
    assert "a sparse policy needs its sparsity" in done.stderr
    assert "add --gym-packages sb3_sparse.rl_zoo_optimize" in done.stderr
    stock = "CartPole-v1:\n  n_timesteps: 120\n  policy: MlpPolicy\n"
    stock += "  policy_kwargs: {net_arch: [17], normalize_images: False}\n"
    done = optimize("dqn", stock, tmp_path, "--gym-packages", "sb3_sparse.rl_zoo_optimize")
    assert done.returncode == 0, done.stderr
    model = DQN.load(tmp_path / "trials" / "trial_0" / "best_model.zip")
    assert model.policy_kwargs.keys() == {"net_arch"}  # replaced, as rl-zoo does
