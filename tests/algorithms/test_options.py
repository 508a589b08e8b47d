"""Options of the algorithms, spaces and activations: as in stock SB3."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
from algorithms_support import (
    BOX,
    STOCK,
    Noise,
    assert_alike,
    assert_like_stock,
    learn,
    make,
    reason_of,
)
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

import sb3_sparse


@dataclass(frozen=True)
class Linear:
    """A schedule; what it prints is the same in every process."""

    start: float

    def __call__(self, remaining):
        return self.start * (0.1 + remaining)


LEAN = dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))
OPTIONS = [
    ("SAC", dict(ent_coef=0.1)),
    ("SAC", dict(ent_coef="auto_0.3", target_entropy=-1.0)),
    ("SAC", dict(gradient_steps=3, target_update_interval=2, train_freq=3)),
    ("SAC", dict(gradient_steps=-1, train_freq=(1, "episode"))),
    ("SAC", dict(learning_rate=Linear(1e-3), tau=0.5, gamma=0.9)),
    ("SAC", dict(n_steps=3, gamma=0.7)),
    ("SAC", dict(policy_kwargs=dict(n_critics=1))),
    ("SAC", dict(policy_kwargs=dict(n_critics=3, activation_fn=nn.Tanh))),
    ("SAC", dict(policy_kwargs=dict(net_arch=dict(pi=[20], qf=[12, 30, 7])))),
    ("SAC", dict(policy_kwargs=dict(net_arch=[]))),
    ("SAC", dict(policy_kwargs=dict(share_features_extractor=True))),
    ("SAC", dict(policy_kwargs=dict(weight_decay=1e-2))),
    ("SAC", dict(policy_kwargs=dict(sparsity=dict(actor=0.9, critic=0.3)))),
    ("SAC", dict(LEAN, buffer_size=30)),
    ("DQN", dict(LEAN, buffer_size=200)),
    ("TD3", dict(policy_delay=3, target_policy_noise=0.4, target_noise_clip=0.2)),
    ("TD3", dict(policy_delay=1, gradient_steps=2, tau=0.1, n_steps=2)),
    ("TD3", dict(policy_kwargs=dict(n_critics=3))),
    ("TD3", dict(learning_rate=Linear(1e-3), policy_kwargs=dict(weight_decay=1e-2))),
    ("DDPG", dict(policy_kwargs=dict(n_critics=2), n_steps=2)),
    ("DDPG", dict(tau=0.9, gradient_steps=2)),
    ("DQN", dict(max_grad_norm=0.05, tau=0.3)),
    ("DQN", dict(n_steps=3, gradient_steps=2, train_freq=2)),
    ("DQN", dict(learning_rate=Linear(1e-3), gamma=0.5)),
    ("TQC", dict(top_quantiles_to_drop_per_net=0)),
    ("TQC", dict(top_quantiles_to_drop_per_net=5, n_steps=3, gamma=0.7)),
    ("TQC", dict(ent_coef=0.1, gradient_steps=3, target_update_interval=2, train_freq=3)),
    ("TQC", dict(learning_rate=Linear(1e-3), tau=0.5, policy_kwargs=dict(weight_decay=1e-2))),
    ("TQC", dict(policy_kwargs=dict(n_critics=3, n_quantiles=25, net_arch=[20]))),
    ("TQC", dict(policy_kwargs=dict(n_critics=1, n_quantiles=1), top_quantiles_to_drop_per_net=0)),
    ("QRDQN", dict(max_grad_norm=0.05, tau=0.3)),
    ("QRDQN", dict(n_steps=3, gradient_steps=2, train_freq=2, learning_rate=Linear(1e-3))),
    ("QRDQN", dict(policy_kwargs=dict(n_quantiles=1, net_arch=[]))),
    ("QRDQN", dict(policy_kwargs=dict(n_quantiles=200), gamma=0.5)),
    ("CrossQ", dict(policy_delay=1, ent_coef=0.1, n_steps=3, gamma=0.7)),
    ("CrossQ", dict(policy_delay=3, gradient_steps=4, train_freq=2, learning_rate=Linear(1e-3))),
    ("CrossQ", dict(policy_kwargs=dict(n_critics=3, net_arch=dict(pi=[20], qf=[12, 30, 7])))),
    ("CrossQ", dict(policy_kwargs=dict(renorm_warmup_steps=7))),  # which ends on the way
    ("CrossQ", dict(policy_kwargs=dict(batch_norm_momentum=0.3, batch_norm_eps=0.1, n_critics=1))),
    ("CrossQ", dict(policy_kwargs=dict(batch_norm=False, weight_decay=1e-2))),
    ("CrossQ", dict(policy_kwargs=dict(net_arch=[], share_features_extractor=True))),
    ("PPO", dict(clip_range=Linear(0.01), clip_range_vf=Linear(0.02), learning_rate=Linear(1e-3))),
    ("PPO", dict(normalize_advantage=False, ent_coef=0.05, vf_coef=0.1, max_grad_norm=0.05)),
    ("PPO", dict(target_kl=1e-3, learning_rate=3e-3, clip_range=0.02)),
    ("PPO", dict(batch_size=31)),  # the last batch is one transition, which is not normalised
    ("PPO", dict(batch_size=200)),
    ("PPO", dict(policy_kwargs=dict(net_arch=dict(pi=[20], vf=[12, 30])))),
    ("PPO", dict(policy_kwargs=dict(net_arch=[], log_std_init=-1.0))),
    ("PPO", dict(policy_kwargs=dict(ortho_init=False, share_features_extractor=False))),
    ("A2C", dict(normalize_advantage=True, ent_coef=0.05, vf_coef=0.1, max_grad_norm=0.05)),
    ("A2C", dict(use_rms_prop=False, learning_rate=Linear(1e-3), gae_lambda=0.9)),
    ("A2C", dict(rms_prop_eps=1e-3, policy_kwargs=dict(weight_decay=1e-2))),
]  # fmt: skip


@pytest.mark.parametrize(("name", "options"), OPTIONS)
def test_an_option(name, options):
    kwargs = {key: dict(v) if isinstance(v, dict) else v for key, v in options.items()}
    assert_like_stock(name, **kwargs)


ACTIVATIONS = [nn.ReLU, nn.Tanh, nn.ELU, nn.SiLU, nn.GELU, nn.LeakyReLU, nn.Identity, nn.Sigmoid]


@pytest.mark.parametrize("name", ["SAC", "PPO"])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_an_activation(name, activation):
    assert_like_stock(name, policy_kwargs=dict(activation_fn=activation))


OTHER_ACTIVATIONS = {
    "tanh gelu": lambda: nn.GELU(approximate="tanh"),
    "elu": lambda: nn.ELU(alpha=0.4),
    "leaky": lambda: nn.LeakyReLU(0.3),
    "no slope": lambda: nn.LeakyReLU(0.0),
    "relu6": nn.ReLU6,
    "celu": lambda: nn.CELU(0.7),
    "selu": nn.SELU,
    "hardtanh": lambda: nn.Hardtanh(-0.2, 0.3),
}


@pytest.mark.parametrize("which", OTHER_ACTIVATIONS)
@pytest.mark.parametrize("name", ["TD3", "A2C"])
def test_an_activation_with_settings(name, which):
    assert_like_stock(name, policy_kwargs=dict(activation_fn=OTHER_ACTIVATIONS[which]))


ACTIONS = [
    spaces.Discrete(2),
    spaces.Discrete(6, start=0),
    spaces.MultiDiscrete([3, 2, 4]),
    spaces.MultiDiscrete([5]),
    spaces.MultiBinary(4),
    spaces.MultiBinary(1),
    spaces.Box(-2.0, 3.0, (1,)),
    spaces.Box(-2.0, 3.0, (2, 2)),
    spaces.Box(-1.0, 1.0, (2,), np.float64),
]


@pytest.mark.parametrize("space", ACTIONS, ids=str)
@pytest.mark.parametrize("name", ["PPO", "A2C"])
def test_actions_of_rollouts(name, space):
    assert_like_stock(name, env=lambda: Noise(space), ent_coef=0.01)


@pytest.mark.parametrize("space", ACTIONS[-3:], ids=str)
@pytest.mark.parametrize("name", ["SAC", "TD3", "DDPG"])
def test_actions_of_replay(name, space):
    assert_like_stock(name, env=lambda: Noise(space))


OBSERVATIONS = [
    spaces.Box(-1.0, 1.0, (4,), np.float64),
    spaces.Box(-1.0, 1.0, (4,), np.float16),
    spaces.Box(-9, 9, (3, 2), np.int64),
    spaces.Box(-9, 9, (3,), np.int32),
    spaces.Box(-9, 9, (3,), np.int16),
    spaces.Box(-9, 9, (3,), np.int8),
    spaces.Box(0, 9, (3,), np.uint16),
    spaces.Box(0, 255, (3,), np.uint8),
    spaces.Box(0, 255, (36, 36, 1), np.uint8),
    spaces.Discrete(5),
    spaces.MultiDiscrete([3, 4]),
    spaces.MultiBinary(6),
]


@pytest.mark.parametrize("space", OBSERVATIONS, ids=str)
@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_observations(name, space):
    kwargs = {} if name == "PPO" else dict(batch_size=20)
    assert_like_stock(name, env=lambda: Noise(BOX, space), policy="SparseMlpPolicy", **kwargs)


@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN", "PPO", "A2C"])
def test_several_environments_normalised_and_stacked(name):
    space = spaces.Discrete(4) if name == "DQN" else BOX

    def env():
        envs = DummyVecEnv([lambda: Noise(space)] * 3)
        return VecNormalize(VecFrameStack(envs, 2), gamma=0.9)

    assert_like_stock(name, env=env, steps={"PPO": 192, "A2C": 150}.get(name, 110))


@pytest.mark.parametrize("batch", [1, 63, 64, 65, 200])
@pytest.mark.parametrize("name", ["SAC", "DQN"])
def test_batches_that_fill_tiles_in_part(name, batch):
    assert_like_stock(name, batch_size=batch)


@pytest.mark.parametrize("noise", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
@pytest.mark.parametrize("name", ["SAC", "TD3"])
def test_noise_on_actions(name, noise):
    assert_like_stock(name, action_noise=noise(np.zeros(3), np.full(3, 0.2)))


class Goals(gym.Env):
    """A goal to reach, as hindsight replay asks for."""

    def __init__(self):
        part = spaces.Box(-1.0, 1.0, (2,))
        names = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict(dict.fromkeys(names, part))
        self.action_space = BOX
        self._random = np.random.default_rng(0)
        self._steps = 0

    def compute_reward(self, achieved, desired, info):
        return -np.linalg.norm(achieved - desired, axis=-1)

    def _look(self):
        return {name: self._random.uniform(-1, 1, 2).astype(np.float32)
                for name in self.observation_space}  # fmt: skip

    def reset(self, *, seed=None, options=None):
        return self._look(), {}

    def step(self, action):
        self._steps += 1
        obs = self._look()
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}))
        return obs, reward, False, self._steps % 6 == 0, {}


def test_hindsight_replay_is_stock_training():
    models = [
        learn(make(library, "SAC", Goals(), replay_buffer_class=stable_baselines3.HerReplayBuffer))
        for library in (sb3_sparse, STOCK)
    ]
    assert "CombinedExtractor" in reason_of(models[0])
    assert_alike(*models, exact=True)
