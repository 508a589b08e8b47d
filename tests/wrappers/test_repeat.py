"""Repeated actions: what is summed, where an episode ends, Gymnasium's own checker."""

from __future__ import annotations

import gymnasium as gym
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from sb3_sparse.errors import ConfigError
from sb3_sparse.wrappers import ActionRepeat


class Counting(gym.Env):
    """The observation is the number of steps, and so is the reward."""

    observation_space = spaces.Discrete(100)
    action_space = spaces.Discrete(5)

    def __init__(self, ends=100, truncates=100):
        self.ends, self.truncates = ends, truncates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.actions = 0, []
        return 0, {}

    def step(self, action):
        self.steps += 1
        self.actions.append(action)
        over = self.steps >= self.ends, self.steps >= self.truncates
        return self.steps, float(self.steps), *over, {"steps": self.steps}


def test_rewards_add_up_and_the_last_observation_counts():
    env = ActionRepeat(Counting(), repeat=3)
    env.reset()
    assert env.step(4) == (3, 1.0 + 2.0 + 3.0, False, False, {"steps": 3})
    assert env.step(1) == (6, 4.0 + 5.0 + 6.0, False, False, {"steps": 6})
    assert env.unwrapped.actions == [4, 4, 4, 1, 1, 1]


@pytest.mark.parametrize(("limits", "how"), [((4, 100), (True, False)), ((100, 4), (False, True))])
def test_an_episode_that_ends_between_two_repetitions_ends_there(limits, how):
    env = ActionRepeat(Counting(*limits), repeat=3)
    env.reset()
    env.step(0)
    assert env.step(0) == (4, 4.0, *how, {"steps": 4})
    assert env.unwrapped.steps == 4


def test_one_repetition_changes_nothing():
    plain, repeated = Counting(), ActionRepeat(Counting(), repeat=1)
    plain.reset()
    repeated.reset()
    assert [plain.step(2) for _ in range(5)] == [repeated.step(2) for _ in range(5)]


@pytest.mark.parametrize("repeat", [0, -1, 1.5, "2", True])
def test_another_number_of_repetitions_is_an_error(repeat):
    with pytest.raises(ConfigError, match="repeat must be a whole number, 1 or more, got"):
        ActionRepeat(Counting(), repeat)


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_finds_nothing_wrong():
    check_env(ActionRepeat(gym.make("Pendulum-v1").unwrapped, repeat=2), skip_render_check=True)


def test_half_as_many_decisions_as_steps():
    env = ActionRepeat(gym.make("Pendulum-v1"), repeat=2)
    env.reset(seed=0)
    decisions = 1
    while not env.step(env.action_space.sample())[3]:
        decisions += 1
    assert decisions == 100
