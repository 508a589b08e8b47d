"""The features extractor that SB3 would choose."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)

from sb3_sparse.errors import UnsupportedError

SUPPORTED = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Dict)


def choose_extractor(
    observation_space: spaces.Space[Any], normalize_images: bool
) -> type[BaseFeaturesExtractor]:
    """NatureCNN for images, CombinedExtractor for dicts, else flat.

    :raises UnsupportedError: for an observation space that SB3 cannot preprocess
    """
    if not isinstance(observation_space, SUPPORTED):
        raise UnsupportedError(
            f"observations of type {type(observation_space).__name__} are not supported; allowed "
            f"are {', '.join(space.__name__ for space in SUPPORTED)}"
        )
    if isinstance(observation_space, spaces.Dict):
        return CombinedExtractor
    if is_image_space(observation_space, normalized_image=not normalize_images):
        return NatureCNN
    return FlattenExtractor
