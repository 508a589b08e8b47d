"""How many threads torch gets."""

from __future__ import annotations

import os
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space


def use_few_threads(observation_space: spaces.Space[Any]) -> None:
    """One thread for networks without convolutions, which more threads only slow down.

    ``OMP_NUM_THREADS`` decides where it is set.
    """
    images = isinstance(observation_space, spaces.Dict) or is_image_space(observation_space)
    if "OMP_NUM_THREADS" not in os.environ and not images:
        th.set_num_threads(1)
