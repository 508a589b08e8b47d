"""The algorithm and the environment that a user leaves out."""

from __future__ import annotations

import gymnasium as gym
import pytest

from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.choice import chosen


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((None, None), ("sac", "Pendulum-v1")),
        (("dqn", None), ("dqn", "CartPole-v1")),
        (("ppo", None), ("ppo", "CartPole-v1")),
        (("td3", None), ("td3", "Pendulum-v1")),
        ((None, "CartPole-v1"), ("dqn", "CartPole-v1")),
        ((None, "MountainCarContinuous-v0"), ("sac", "MountainCarContinuous-v0")),
        (("ppo", "Pendulum-v1"), ("ppo", "Pendulum-v1")),
        (("sac", "CartPole-v1"), ("sac", "CartPole-v1")),  # which the run rejects
    ],
)
def test_what_is_left_out_suits_what_is_given(given, expected):
    assert chosen(*given) == expected


def test_an_environment_of_ones_own_is_asked_for_its_actions():
    assert chosen(None, "my_envs:Maze-v0") == ("dqn", "my_envs:Maze-v0")
    assert chosen(None, "Maze-v0", ["my_envs"]) == ("dqn", "Maze-v0")


def test_an_environment_that_cannot_be_made_needs_an_algorithm():
    def broken() -> gym.Env:
        raise RuntimeError("no board is connected")

    gym.register("Broken-v0", broken)
    try:
        with pytest.raises(ConfigError, match="give --algo: RuntimeError: no board is connected"):
            chosen(None, "Broken-v0")
    finally:
        del gym.registry["Broken-v0"]
