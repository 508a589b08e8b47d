"""With sparsity 0 training is stock SB3's, number for number."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.logger import KVWriter, Logger
from support import make


class Recorder(KVWriter):
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.rows: list[dict[str, object]] = []

    def write(self, key_values, key_excluded, step=0) -> None:
        self.rows.append(
            {k: v for k, v in key_values.items() if k not in ("time/fps", "time/time_elapsed")}
        )

    def close(self) -> None:
        pass


def logged(model, steps: int) -> list[dict[str, object]]:
    recorder = Recorder()
    model.set_logger(Logger(folder=None, output_formats=[recorder]))
    model.learn(steps, log_interval=1)
    return recorder.rows


# To the bit with masks; other kernels round otherwise, so the next test compares up to rounding.
@pytest.mark.parametrize("storage", ["masked"], indirect=True)
@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("name", ["DQN", "SAC", "PPO"])
def test_losses_returns_and_weights_equal_those_of_stock_sb3(name, fused):
    env = "CartPole-v1" if name == "DQN" else "Pendulum-v1"
    envs = [gym.make(env, max_episode_steps=30) for _ in range(2)]
    dense = make(name, policy="MlpPolicy")
    optimizer_kwargs = dict(dense.policy.optimizer_kwargs, fused=fused)
    kwargs = dict(optimizer_kwargs=dict(optimizer_kwargs))
    dense = make(name, envs[0], "MlpPolicy", kwargs)
    rows = logged(dense, 125)
    sparse = make(name, envs[1], policy_kwargs=dict(kwargs, sparsity=0.0))
    assert rows == logged(sparse, 125)
    assert any(key.startswith("train/") and "loss" in key for row in rows for key in row)
    assert any("rollout/ep_rew_mean" in row for row in rows)
    ours = dict(sparse.policy.named_parameters())
    for key, value in dense.policy.named_parameters():
        assert (ours[key] == value).all(), key


@pytest.mark.parametrize(("name", "steps"), [("DQN", 50), ("SAC", 50), ("PPO", 32)])
def test_thirty_updates_move_weights_as_those_of_stock_sb3(name, steps):
    dense = make(name, policy="MlpPolicy").learn(steps)
    sparse = make(name, policy_kwargs=dict(sparsity=0.0)).learn(steps)
    ours = sparse.policy.state_dict()
    for key, value in dense.policy.state_dict().items():
        np.testing.assert_allclose(ours[key], value, rtol=1e-4, atol=1e-6, err_msg=key)


def test_a_stock_policy_and_a_sparse_one_draw_the_same_global_random_numbers():
    def state_after(policy: str, **kwargs: float) -> tuple[float, float]:
        make("SAC", policy=policy, policy_kwargs=kwargs)
        return float(np.random.rand()), float(th.rand(()))

    assert state_after("MlpPolicy") == state_after("SparsePolicy", sparsity=0.9)
