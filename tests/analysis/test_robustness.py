"""Returns under noise."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from support import make

from sb3_sparse.analysis import feature_std, noise_robustness, noisy_vec_env
from sb3_sparse.errors import ConfigError


class Grey(gym.Env):
    """Images of one grey; as many steps as they were told, each for a reward of 1."""

    observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)
    action_space = spaces.Discrete(3)

    def __init__(self, grey: int = 100) -> None:
        self.grey = grey

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 12))
        return np.full((36, 36, 1), self.grey, np.uint8), {}

    def step(self, action):
        self.left -= 1
        return np.full((36, 36, 1), self.grey, np.uint8), 1.0, self.left == 0, False, {}


STD = [1.0, 1.0, 0.2, 1.0]


def test_noise_is_on_every_frame_once_and_on_the_first():
    envs = noisy_vec_env(Grey, 10.0, n_envs=2, seed=0, frame_stack=2)
    first = envs.reset()
    assert first.shape == (2, 36, 36, 2)
    noise = first[..., 1].astype(float) - 100
    assert 9 < noise.std() < 11
    assert not first[..., 0].any()  # what is stacked before the first frame
    second = envs.step([0, 0])[0]
    np.testing.assert_array_equal(second[..., 0], first[..., 1])
    dark = noisy_vec_env(Grey, 10.0, seed=0, env_kwargs={"grey": 250}).reset()
    assert dark.max() == 255
    assert dark.min() > 200  # saturates, wraps nowhere


def test_vectors_get_noise_in_units_of_their_std():
    clean = noisy_vec_env("CartPole-v1", 0.0, n_envs=500, seed=0, std=STD).reset()
    noise = noisy_vec_env("CartPole-v1", 0.5, n_envs=500, seed=0, std=STD).reset() - clean
    np.testing.assert_allclose(noise.std(axis=0), 0.5 * np.array(STD), rtol=0.15)
    with pytest.raises(ConfigError, match="feature_std"):
        noisy_vec_env("CartPole-v1", 0.5)
    with pytest.raises(ConfigError, match="grey levels"):
        noisy_vec_env(Grey, 0.5, std=STD)


@pytest.mark.parametrize("policy", ["SparsePolicy", "SparseSimbaPolicy"])
@pytest.mark.parametrize("deterministic", [True, False])
def test_returns_are_the_monitors_and_depend_on_the_seed_alone(deterministic, policy):
    model = make("DQN", Grey(), policy=policy, policy_kwargs={"net_arch": [8]})
    model.exploration_rate = 0.5

    def envs(sigma):
        return noisy_vec_env(Grey, sigma, n_envs=3)

    def measure():
        return noise_robustness(model, envs, [0, 20.0], 7, (1, 2), deterministic)

    state = model.action_space.np_random.bit_generator.state
    torch_state = th.get_rng_state()
    found = measure()
    assert model.action_space.np_random.bit_generator.state == state
    assert th.equal(th.get_rng_state(), torch_state)
    rows = list(found.rows())
    assert [(s, seed, e) for s, seed, e, _ in rows] == [
        (s, seed, e) for s in (0, 20.0) for seed in (1, 2) for e in range(7)
    ]
    assert measure() == found
    # Actions and noise mean nothing to these episodes: their lengths come from the seed
    assert found.returns[0, 1] == found.returns[20.0, 1] != found.returns[0, 2]
    values = [value for s, _, _, value in rows if s == 0]
    assert found.means()[0] == pytest.approx(np.mean(values))
    assert 2 <= min(values) <= max(values) < 12
    assert "sigma 20: " in str(found)


def test_short_episodes_are_not_preferred():
    # One environment ends after 1 step, the other after 11; each plays half of the episodes
    class Fixed(Grey):
        def reset(self, *, seed=None, options=None):
            observation, info = super().reset(seed=seed)
            self.left = self.grey
            return observation, info

    from stable_baselines3.common.monitor import Monitor

    def envs(sigma):
        return DummyVecEnv([lambda g=g: Monitor(Fixed(g)) for g in (1, 11)])

    model = make("DQN", Grey(), policy_kwargs={"net_arch": [8]})
    assert noise_robustness(model, envs, [0], 6).means() == {0: 6.0}


def test_std_of_features_is_before_normalisation(tmp_path):
    plain = noisy_vec_env("Pendulum-v1", 0.0, n_envs=4, std=[1.0] * 3)
    model = make("SAC", policy="MlpPolicy")
    std = feature_std(model, plain, 400)
    assert std.shape == (3,)
    assert std[2] > 0.5  # angular velocity
    normal = VecNormalize(noisy_vec_env("Pendulum-v1", 0.0, n_envs=4, std=[1.0] * 3))
    normal.obs_rms.var = np.full(3, 100.0)
    normal.save(str(tmp_path / "normal.pkl"))
    with pytest.raises(ConfigError, match="still updates"):
        feature_std(model, normal, 400)
    with pytest.raises(ConfigError, match="still updates"):
        noise_robustness(model, lambda _: normal, [0])
    normal.training = False
    first = noisy_vec_env("Pendulum-v1", 0.0, seed=3, std=[1.0] * 3).reset()
    path = str(tmp_path / "normal.pkl")
    frozen = noisy_vec_env("Pendulum-v1", 0.0, seed=3, std=[1.0] * 3, normalize=path)
    np.testing.assert_allclose(frozen.reset(), first / 10, rtol=1e-4)
    assert feature_std(model, normal, 400)[2] > 0.3


def test_what_cannot_be_measured_says_so():
    model = make("DQN", Grey(), policy_kwargs={"net_arch": [8]})
    with pytest.raises(ConfigError, match="Monitor"):
        noise_robustness(model, lambda _: DummyVecEnv([Grey]), [0])
    for wrong in (dict(sigmas=[]), dict(n_episodes=0), dict(seeds=[1, 1])):
        with pytest.raises(ConfigError):
            noise_robustness(model, lambda _: DummyVecEnv([Grey]), **wrong)
