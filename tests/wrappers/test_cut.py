"""Episodes that wrappers end: what is reported of them, and what stays unreported."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit, TransformReward
from stable_baselines3.common.atari_wrappers import EpisodicLifeEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_sparse.wrappers import CutEpisodes


class Counting(gym.Env):
    """The number of the step is its reward; a game has lives, and is over after ``ends`` steps."""

    observation_space = spaces.Box(-1.0, 1.0, (1,))
    action_space = spaces.Discrete(2)

    def __init__(self, ends=100, lost=()):
        self.ends, self.lost, self.steps = ends, lost, 0
        self.ale = SimpleNamespace(lives=lambda: 5 - sum(at <= self.steps for at in self.lost))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        over = self.steps >= self.ends
        return np.zeros(1, np.float32), float(self.steps), over, False, {"is_success": over}


class EndsAt(gym.Wrapper):
    """Ends an episode at the goal, as a wrapper of a user's may."""

    def step(self, action):
        observation, reward, _, truncated, info = self.env.step(action)
        return observation, reward, self.unwrapped.steps == 4, truncated, info


class Still:
    """Predicts the action 0."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros(len(observation), dtype=int), state


def limited(env):
    return TimeLimit(env, 3)


def halved(env):
    return TransformReward(env, lambda reward: reward / 2)


def made(wrapper, vec_env_cls=DummyVecEnv, n_envs=1, **of):
    def wrapped(env):
        return CutEpisodes(wrapper(env))

    return make_vec_env(
        Counting, n_envs, wrapper_class=wrapped, vec_env_cls=vec_env_cls, env_kwargs=of
    )


def evaluated(envs, episodes):
    try:
        return evaluate_policy(Still(), envs, episodes, return_episode_rewards=True)
    finally:
        envs.close()


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize(
    ("wrapper", "rewards"),
    [(limited, [1, 2, 3]), (EndsAt, [1, 2, 3, 4])],
)
def test_an_evaluation_counts_the_episodes_that_a_wrapper_ends(kind, wrapper, rewards):
    envs = made(lambda env: wrapper(halved(env)), kind, n_envs=2)
    returns, lengths = evaluated(envs, episodes=4)
    assert returns == 4 * [sum(rewards)]  # the environment's own rewards, as Monitor's are
    assert lengths == 4 * [len(rewards)]


def test_episodes_of_monitors_own_stay_as_they_are():
    returns, _ = evaluated(made(limited, ends=2), episodes=3)
    assert returns == [3, 3, 3]


def test_an_outer_monitor_reports_first():
    envs = made(lambda env: Monitor(halved(TimeLimit(env, 2))))
    assert evaluated(envs, episodes=2)[0] == [1.5, 1.5]


def test_the_loss_of_a_life_ends_no_game():
    # EpisodicLifeEnv takes a step where the next life begins, so a game has rewards 1 to 6.
    envs = made(EpisodicLifeEnv, ends=6, lost=[2, 4])
    assert evaluated(envs, episodes=3) == ([21, 21, 21], [6, 6, 6])


def test_a_game_that_ends_between_two_lives_is_not_reported_twice():
    envs = made(EpisodicLifeEnv, ends=3, lost=[2])
    envs.reset()
    infos = [envs.step(np.array([0]))[3][0] for _ in range(6)]
    assert not any("episode" in info for info in infos)
    assert envs.envs[0].get_wrapper_attr("monitor").episode_lengths == [3, 3, 3]


class Secretive(gym.Wrapper):
    """Gives no info of what is inside."""

    def step(self, action):
        return *self.env.step(action)[:4], {}


def test_a_report_that_a_wrapper_drops_is_given_again_but_not_recorded_twice():
    envs = made(lambda env: limited(Secretive(env)), ends=2)
    assert evaluated(envs, episodes=3)[0] == [3, 3, 3]
    assert envs.envs[0].get_wrapper_attr("monitor").episode_returns == [3, 3, 3]


def test_a_reset_in_mid_episode_reports_nothing():
    env = CutEpisodes(TimeLimit(Monitor(Counting()), 3))
    env.reset()
    *_, info = env.step(0)
    env.reset()
    assert "episode" not in info
    assert env.monitor.episode_returns == []


def test_monitor_records_the_episodes_too(tmp_path):
    monitor = Monitor(Counting(), str(tmp_path / "0"), info_keywords=("is_success",))
    env = CutEpisodes(TimeLimit(monitor, 2))
    for _ in range(3):
        env.reset()
        for _ in range(2):
            *_, info = env.step(0)
    env.reset()
    env.close()
    assert {**info["episode"], "t": None} == {"r": 3.0, "l": 2, "t": None, "is_success": False}
    assert (monitor.get_episode_rewards(), monitor.get_episode_lengths()) == (3 * [3.0], 3 * [2])
    assert load_results(str(tmp_path))[["r", "l"]].to_numpy().tolist() == 3 * [[3.0, 2]]


def test_without_a_monitor_it_does_nothing():
    env = CutEpisodes(TimeLimit(Counting(), 1))
    env.reset()
    *_, info = env.step(0)
    env.reset()
    assert "episode" not in info


def test_it_is_an_environment_by_gymnasiums_checker():
    check_env(CutEpisodes(gym.make("Pendulum-v1")), skip_render_check=True)
