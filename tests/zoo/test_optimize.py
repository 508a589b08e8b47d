"""rl-zoo's own hyperparameter search trains with the sparsity of the config."""

from __future__ import annotations

import pytest
from stable_baselines3 import DQN, PPO, SAC
from zoo_support import run_zoo

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
STOCK = """
CartPole-v1:
  n_timesteps: 120
  policy: MlpPolicy
  policy_kwargs: {net_arch: [17], normalize_images: False}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("searches")


@pytest.fixture(scope="module")
def searches(folder):
    """How searches end: of each algorithm, without our module, and of a stock policy."""
    ours = "sb3_sparse.rl_zoo_optimize"
    planned = {algo: (algo, CONFIG.format(env=env), ours) for algo, env in ENVS.items()}
    planned["without"] = "dqn", CONFIG.format(env="CartPole-v1"), "sb3_sparse.zoo"
    planned["stock"] = "dqn", STOCK, ours
    many = {}
    for name, (algo, config, package) in planned.items():
        (folder / f"{name}.yml").write_text(config)
        command = [
            "train", "--algo", algo, "--env", ENVS[algo], "--conf-file", f"../{name}.yml",
            "-optimize", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1",
            "-n", "120", "--no-optim-plots", "--seed", "1", "--optimization-log-path", "trials",
            "--gym-packages", package,
        ]  # fmt: skip
        many[name] = [command]
    return run_zoo(folder, many)


@pytest.mark.parametrize("algo", sorted(ENVS))
def test_each_trial_trains_with_the_configs_sparsity(algo, searches, folder):
    assert searches[algo].error is None
    models = sorted(folder.glob(f"{algo}/trials/trial_*/best_model.zip"))
    assert len(models) == 2
    for path in models:
        policy = CLASSES[algo].load(path).policy
        report = policy.sparsity_report()
        assert policy.sparsity_config.distribution == "uniform"
        for layer in report.layers:
            assert layer.size - layer.nnz == int(0.3 * layer.size)  # zeros, by section 2
        widths = {layer.shape[0] for layer in report.layers}
        assert 17 not in widths  # the width is the sampler's, as in rl-zoo


def test_without_it_the_sparsity_is_missed(searches):
    error = searches["without"].error
    assert "a sparse policy needs its sparsity" in error
    assert "add --gym-packages sb3_sparse.rl_zoo_optimize" in error


def test_a_stock_policy_is_left_alone(searches, folder):
    assert searches["stock"].error is None
    model = DQN.load(folder / "stock" / "trials" / "trial_0" / "best_model.zip")
    assert model.policy_kwargs.keys() == {"net_arch"}  # replaced, as rl-zoo does
