"""How a process that trains or acts computes."""

from __future__ import annotations

import os
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space


def compute_fast(observation_space: spaces.Space[Any]) -> None:
    """One thread for networks without convolutions, and numbers below 1.2e-38 taken as 0.

    More threads only slow small networks down; ``OMP_NUM_THREADS`` decides where it is set.
    Weight decay drives the weights of units that never fire, and Adam's moments of them, into
    denormal numbers, with which a processor is slow: a gradient step of the paper's dense DQN
    takes 29 instead of 4 ms after some thousand steps.
    """
    images = isinstance(observation_space, spaces.Dict) or is_image_space(observation_space)
    if "OMP_NUM_THREADS" not in os.environ and not images:
        th.set_num_threads(1)
    th.set_flush_denormal(True)
