"""Settings that speed up a process that trains or acts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space


def use_few_threads(observation_space: spaces.Space[Any]) -> None:
    """Use one thread for networks without convolutions, which more threads only slow down.

    ``OMP_NUM_THREADS`` takes precedence if it is set.
    """
    images = isinstance(observation_space, spaces.Dict) or is_image_space(observation_space)
    if "OMP_NUM_THREADS" not in os.environ and not images:
        th.set_num_threads(1)


@contextmanager
def denormals_as_zero() -> Iterator[None]:
    """Treat numbers below 1.2e-38 as 0 in this thread.

    Weight decay drives the weights of units that never fire, and their Adam moments, into
    denormal numbers, which slow a processor down: after a few thousand steps, a gradient step of
    the paper's dense DQN takes 29 instead of 4 ms.
    """
    before = (th.tensor(1e-38) * 1e-2).item() == 0.0
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(before)
