"""An environment of noise, for timing."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

VECTOR = spaces.Box(-1.0, 1.0, (17,), np.float32)
IMAGE = spaces.Box(0, 255, (4, 84, 84), np.uint8)
TORQUES = spaces.Box(-1.0, 1.0, (6,), np.float32)


class RandomEnv(gym.Env):
    """Gives random observations of the given space and random rewards; episodes never end."""

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space) -> None:
        self.observation_space = observation_space
        self.action_space = action_space

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=kwargs.get("seed"))
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), float(np.random.randn()), False, False, {}
