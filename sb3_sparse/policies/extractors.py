"""The features extractor that SB3 would choose, and copies of a user's modules."""

from __future__ import annotations

import copy
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from torch import nn

from sb3_sparse.errors import UnsupportedError

SUPPORTED = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Dict)


def choose_extractor(
    observation_space: spaces.Space[Any], normalize_images: bool
) -> type[BaseFeaturesExtractor]:
    """The default class: NatureCNN for images, CombinedExtractor for dicts, else FlattenExtractor.

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


def copied_modules(value: Any, memo: dict[int, Any] | None = None) -> Any:
    """Copy all modules and tensors in a nested value; everything else is shared.

    :param value: for instance keyword arguments
    :param memo: copies made so far, so that a module given twice is copied once
    """
    memo = {} if memo is None else memo
    if isinstance(value, (nn.Module, th.Tensor)):
        return copy.deepcopy(value, memo)
    if type(value) is dict:
        return {key: copied_modules(entry, memo) for key, entry in value.items()}
    if type(value) in (list, tuple):
        return type(value)(copied_modules(entry, memo) for entry in value)
    return value
