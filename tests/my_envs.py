"""The package that the documents name where a user would name one of his own."""

from __future__ import annotations

import gymnasium as gym
from gymnasium.envs.classic_control import CartPoleEnv


class Maze(CartPoleEnv):
    """Stands for an environment of a user's."""


gym.register("Maze-v0", entry_point="my_envs:Maze", max_episode_steps=50)
