"""Observations that an export is checked on."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_sparse.errors import ConfigError

Observations = Any
"""An array of observations, one a row, or a dict of such arrays."""
WIDE = 3.0
"""Standard deviations of random observations where nothing bounds them."""
FAR = 1e6
"""A bound beyond this is none."""


def random_observations(
    space: spaces.Space[Any], normalization: VecNormalize | None, count: int
) -> Observations:
    """Raw observations of every kind that a space allows.

    Uniform where the space has bounds; else normal, three times as wide as what was seen, or as 1
    where nothing is known.

    :param space: what the policy sees
    :param normalization: what normalises its observations
    """
    rms = None if normalization is None else normalization.obs_rms
    return _random(space, rms, count, np.random.default_rng(0))


def _random(space: Any, rms: Any, count: int, generator: np.random.Generator) -> Observations:
    if isinstance(space, spaces.Dict):
        known = rms if isinstance(rms, dict) else {}
        return {
            key: _random(part, known.get(key), count, generator)
            for key, part in space.spaces.items()
        }
    shape = (count, *space.shape)
    if isinstance(rms, RunningMeanStd):
        normal = generator.standard_normal(shape)
        return (rms.mean + WIDE * np.sqrt(rms.var) * normal).astype(np.float32)
    if isinstance(space, spaces.Discrete):
        return generator.integers(0, space.n, count)
    if isinstance(space, spaces.MultiDiscrete):
        return generator.integers(np.zeros_like(space.nvec), space.nvec, shape)
    if isinstance(space, spaces.MultiBinary):
        return generator.integers(0, 2, shape).astype(np.int8)
    if np.issubdtype(space.dtype, np.integer):
        return generator.integers(space.low, space.high, shape, space.dtype, endpoint=True)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    bounded = (low > -FAR) & (high < FAR)
    uniform = generator.uniform(np.where(bounded, low, 0), np.where(bounded, high, 1), shape)
    normal = WIDE * generator.standard_normal(shape)
    return np.where(bounded, uniform, normal).astype(space.dtype)


def record_observations(model: BaseAlgorithm, env: VecEnv, count: int) -> Observations:
    """Raw observations that a model meets in an environment, acting deterministically.

    Where frames are stacked after they were normalised there are no raw observations of the
    policy's shape; these are then what the policy sees.

    :param env: with the model's own wrappers, normalised or not; its statistics stay as they are
    :param count: how many
    :raises ConfigError: if the environment shows other observations than the model takes, or takes
        other actions
    """
    shown, taken = env.observation_space.shape, model.observation_space.shape
    if shown != taken and (shown is None or (*shown[2:], *shown[:2]) != taken):
        raise ConfigError(
            f"the environment shows observations of shape {shown}, the model takes {taken}; a "
            "run's folder tells which wrappers and stacked frames belong to it, a zip does not"
        )
    there, here = env.action_space, model.action_space
    if type(there) is not type(here) or (
        there.shape != here.shape if isinstance(here, spaces.Box) else there != here
    ):
        raise ConfigError(
            f"the environment takes actions in {there}, the model chooses from {here}; give the "
            "environment that it was trained in"
        )
    normalization = unwrap_vec_normalize(env)
    training = normalization is not None and normalization.training
    if normalization is not None:
        normalization.training = False
    found: list[Observations] = []
    try:
        observation: Any = env.reset()
        for _ in range(-(-count // env.num_envs)):
            found.append(observation if normalization is None else _raw(normalization, observation))
            action, _ = model.predict(observation, deterministic=True)
            observation, _, _, _ = env.step(action)
    finally:
        if normalization is not None:
            normalization.training = training
    space = model.observation_space
    if isinstance(space, spaces.Dict):
        return {
            key: np.concatenate([maybe_transpose(part[key], sub) for part in found])[:count]
            for key, sub in space.spaces.items()
        }
    return np.concatenate([maybe_transpose(part, space) for part in found])[:count]


def _raw(normalization: VecNormalize, seen: Observations) -> Observations:
    raw: Any = normalization.get_original_obs()
    return seen if np.shape(raw) != np.shape(seen) else raw


def check_recorded(observations: NDArray[Any], space: spaces.Space[Any]) -> None:
    """Refuse recorded observations that are not finite, or not of the policy's shape.

    :raises ConfigError: if so
    """
    shape = space.shape
    if isinstance(observations, dict) != isinstance(space, spaces.Dict):
        raise ConfigError(f"recorded observations must be of {space}, got {type(observations)}")
    if not isinstance(observations, dict) and shape != np.shape(observations)[1:]:
        raise ConfigError(
            f"recorded observations must have a row for each, of shape {shape} as the policy sees "
            f"it (images channels first), got an array of shape {np.shape(observations)}"
        )
    parts = observations.values() if isinstance(observations, dict) else [observations]
    if not all(np.isfinite(part).all() for part in parts):
        raise ConfigError("recorded observations must be finite; some are NaN or infinite")


def count_of(observations: Observations | None) -> int:
    """How many observations there are."""
    if observations is None:
        return 0
    if isinstance(observations, dict):
        return len(next(iter(observations.values())))
    return len(observations)


def rows_of(observations: Observations, first: int, last: int) -> Observations:
    """Some of the observations."""
    if isinstance(observations, dict):
        return {key: part[first:last] for key, part in observations.items()}
    return observations[first:last]
