"""The Impala ResNet."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.engine.residual import Residual
from sb3_sparse.networks.images import check_images, flat_size


class ResidualBlock(Residual):
    """Computes ``x + conv(relu(conv(relu(x))))`` with 3×3 convolutions that keep the size."""

    name = "layers"

    def __init__(self, channels: int) -> None:
        super().__init__(
            nn.ReLU(),  # not in place: x is added below
            nn.Conv2d(channels, channels, kernel_size=3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, kernel_size=3, padding=1),
        )


def stack(inputs: int, outputs: int) -> list[nn.Module]:
    """Build a convolution, a max pool that halves the size (rounded up), and two blocks."""
    return [
        nn.Conv2d(inputs, outputs, kernel_size=3, padding=1),
        nn.MaxPool2d(kernel_size=3, stride=2, padding=1),
        ResidualBlock(outputs),
        ResidualBlock(outputs),
    ]


class ImpalaCNN(BaseFeaturesExtractor):
    """The Impala ResNet: three stacks and one dense layer, without batch normalisation.

    ``net_arch=[]`` puts it directly under the heads; otherwise SB3 adds hidden layers.

    Example::

        import numpy as np
        from gymnasium import spaces
        from sb3_sparse.networks import ImpalaCNN

        images = spaces.Box(0, 255, (4, 84, 84), np.uint8)
        ImpalaCNN(images).features_dim  # 512
        policy_kwargs = dict(features_extractor_class=ImpalaCNN, net_arch=[], sparsity=0.9)

    :param observation_space: images, channels first, of shape (channels, height, width)
    :param channels: channels of the three stacks
    :param features_dim: units of the dense layer
    :param normalized_image: whether images lie in [0, 1] already, as for SB3's ``NatureCNN``
    :raises ConfigError: if the observations are not images

    Source: arXiv:2206.10369, table of the DQN architectures; Espeholt et al. 2018
    (arXiv:1802.01561), figure 3, with twice its channels.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        channels: Sequence[int] = (32, 64, 64),
        features_dim: int = 512,
        normalized_image: bool = False,
    ) -> None:
        space = check_images("ImpalaCNN", observation_space, channels, normalized_image)
        super().__init__(space, features_dim)
        layers: list[nn.Module] = []
        inputs = space.shape[0]
        for outputs in channels:
            layers += stack(inputs, outputs)
            inputs = outputs
        self.cnn = nn.Sequential(*layers, nn.ReLU(), nn.Flatten())
        self.linear = nn.Sequential(nn.Linear(flat_size(self.cnn, space), features_dim), nn.ReLU())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Features of shape (batch, features_dim) from images (batch, channels, height, width)."""
        features: th.Tensor = self.linear(self.cnn(observations))
        return features
