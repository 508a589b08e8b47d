"""Helpers of the image networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.numeric import is_whole


def check_images(
    name: str, observation_space: spaces.Space[Any], channels: Sequence[int], normalized_image: bool
) -> spaces.Box:
    """Validate that an observation space holds channel-first images, and return it.

    :param name: class name for the error message
    :param observation_space: the space
    :param channels: three channel counts, each 1 or more
    :param normalized_image: whether images lie in [0, 1] rather than in 0..255
    :raises ConfigError: if the space holds no images, or if ``channels`` are not three positive
        whole numbers
    """
    if not isinstance(observation_space, spaces.Box) or not is_image_space(
        observation_space, check_channels=False, normalized_image=normalized_image
    ):
        raise ConfigError(
            f"{name} takes images (a Box of uint8 in 0..255, channels first), got "
            f"{observation_space}; vectors need no such extractor, and images in [0, 1] need "
            "normalize_images=False and features_extractor_kwargs=dict(normalized_image=True)"
        )
    if len(channels) != 3 or any(not is_whole(count) or count < 1 for count in channels):
        raise ConfigError(f"channels must be three whole numbers, 1 or more, got {channels!r}")
    return observation_space


def flat_size(network: nn.Module, space: spaces.Box) -> int:
    """Compute the length of the flat output for one observation."""
    with th.no_grad():
        return int(network(th.zeros(1, *space.shape)).shape[1])
