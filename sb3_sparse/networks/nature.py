"""The Nature CNN with other widths."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn

from sb3_sparse.networks.images import check_images, flat_size


class ScaledNatureCNN(NatureCNN):
    """SB3's NatureCNN with a choice of channels, for dense baselines of equal parameter count.

    Example::

        import numpy as np
        from gymnasium import spaces
        from sb3_sparse.networks import ScaledNatureCNN

        images = spaces.Box(0, 255, (4, 84, 84), np.uint8)
        ScaledNatureCNN(images, channels=(10, 20, 20), features_dim=160)

    :param observation_space: images, channels first, of shape (channels, height, width)
    :param channels: channels of the three convolutions
    :param features_dim: units of the dense layer
    :param normalized_image: whether images lie in [0, 1] already, as for SB3's ``NatureCNN``
    :raises ConfigError: if the observations are not images

    Source: Mnih et al. 2015, *Human-level control through deep reinforcement learning*; arXiv:
    2206.10369, table of the DQN architectures.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        channels: Sequence[int] = (32, 64, 64),
        features_dim: int = 512,
        normalized_image: bool = False,
    ) -> None:
        space = check_images("ScaledNatureCNN", observation_space, channels, normalized_image)
        super().__init__(space, features_dim, normalized_image)
        if tuple(channels) == (32, 64, 64):
            return
        first, second, third = channels
        self.cnn = nn.Sequential(
            nn.Conv2d(space.shape[0], first, kernel_size=8, stride=4),
            nn.ReLU(),
            nn.Conv2d(first, second, kernel_size=4, stride=2),
            nn.ReLU(),
            nn.Conv2d(second, third, kernel_size=3, stride=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.linear = nn.Sequential(nn.Linear(flat_size(self.cnn, space), features_dim), nn.ReLU())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Features of shape (batch, features_dim) from images (batch, channels, height, width)."""
        return super().forward(observations)
