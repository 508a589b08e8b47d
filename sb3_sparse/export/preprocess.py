"""Translates what SB3 does to an observation before the features extractor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.activations import scaled
from sb3_sparse.export.graph import Part
from sb3_sparse.export.nodes import Normalize, OneHot, Slice
from sb3_sparse.export.trace import Tracer


@dataclass(frozen=True)
class Observed:
    """The input of an exported policy.

    :param shape: shape of one observation; a dict is one row that concatenates its parts
    :param pixels: whether it is a uint8 image
    :param parts: the parts of a dict
    """

    shape: tuple[int, ...]
    pixels: bool
    parts: tuple[Part, ...] = ()


def observed(space: spaces.Space[Any]) -> Observed:
    """Return the input of a policy with this observation space.

    :raises UnsupportedError: if observations of the space are not numbers
    """
    if isinstance(space, spaces.Dict):
        parts = tuple(
            Part(key, _shape(part), is_image_space(part)) for key, part in space.spaces.items()
        )
        return Observed((sum(part.size for part in parts),), False, parts)
    return Observed(_shape(space) or (1,), is_image_space(space))


def preprocessed(
    tracer: Tracer,
    space: spaces.Space[Any],
    normalization: VecNormalize | None,
    normalize_images: bool,
) -> int | Mapping[str, int]:
    """Return the input of the features extractor, or one for each key of a dict.

    :param normalization: what normalises observations before the policy sees them
    :param normalize_images: whether the policy divides pixels by 255
    """
    rms: Any = None if normalization is None else normalization.obs_rms
    if not isinstance(space, spaces.Dict):
        return _part(tracer, space, 0, rms, normalization, normalize_images)
    values, start = {}, 0
    for part in observed(space).parts:
        value = tracer.add(Slice((0,), part.shape or (1,), start))
        start += part.size
        known = (rms or {}).get(part.key)
        sub = space.spaces[part.key]
        values[part.key] = _part(tracer, sub, value, known, normalization, normalize_images)
    return values


def _shape(space: spaces.Space[Any]) -> tuple[int, ...]:
    allowed = isinstance(space, (spaces.Box, spaces.MultiBinary, spaces.Discrete)) or (
        isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1
    )
    if not allowed:
        raise UnsupportedError(
            f"a policy of observations in {space} cannot be exported; allowed are Box, Discrete, "
            "MultiDiscrete (of one axis), MultiBinary, and Dict of these"
        )
    assert space.shape is not None
    return space.shape


def _part(
    tracer: Tracer,
    space: spaces.Space[Any],
    value: int,
    rms: Any,
    normalization: VecNormalize | None,
    normalize_images: bool,
) -> int:
    shape = tracer.shape_of(value)
    if rms is not None:
        assert normalization is not None
        scale = 1.0 / np.sqrt(rms.var + normalization.epsilon)
        clip = float(normalization.clip_obs)
        value = tracer.add(Normalize((value,), shape, rms.mean, scale, clip))
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        numbers = [space.n] if isinstance(space, spaces.Discrete) else space.nvec
        sizes = tuple(int(number) for number in numbers)
        return tracer.add(OneHot((value,), (sum(sizes),), sizes))
    if normalize_images and is_image_space(space):
        for make in scaled(1.0 / 255.0):
            value = tracer.add(make(value, shape))
    return value
