"""Observations for checking an export."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, maybe_transpose
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_sparse.errors import ConfigError
from sb3_sparse.loading.statistics import mismatch

Observations = Any
"""An array with an observation per row, or a dict of such arrays."""
WIDE = 3.0
"""Width of random observations without bounds, in standard deviations."""
FAR = 1e6
"""Bounds beyond this are ignored."""


def random_observations(
    space: spaces.Space[Any], normalization: VecNormalize | None, count: int
) -> Observations:
    """Draw raw observations from a space.

    Elements are uniform if they have bounds. Others are normal, with three times the standard
    deviation of ``normalization``, or 3 without one.

    :param space: the policy's observation space
    :param normalization: what normalises the observations
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
    """Record the raw observations that a model meets while it acts deterministically.

    If frames are stacked after normalisation, there are no raw observations of the policy's shape,
    and what the policy sees is recorded instead.

    :param env: an environment with the model's wrappers, normalised or not; its statistics do not
        change
    :param count: number of observations
    :raises ConfigError: as :func:`check_spaces`
    """
    check_spaces(model, env)
    normalization = unwrap_vec_normalize(env)
    training = normalization is not None and normalization.training
    if normalization is not None:
        normalization.training = False
    found: list[Observations] = []
    try:
        observation: Any = env.reset()
        for _ in range(-(-count // env.num_envs)):
            found.append(raw_of(normalization, observation, model.observation_space))
            action, _ = model.predict(observation, deterministic=True)
            observation, _, _, _ = env.step(action)
    finally:
        if normalization is not None:
            normalization.training = training
    if isinstance(model.observation_space, spaces.Dict):
        keys = model.observation_space.spaces
        return {key: np.concatenate([part[key] for part in found])[:count] for key in keys}
    return np.concatenate(found)[:count]


def check_spaces(model: BaseAlgorithm, env: VecEnv) -> None:
    """Reject an environment in which a model cannot act.

    :raises ConfigError: if it does not fit the model's observations or actions
    """
    if not _fits(env.observation_space, model.observation_space):
        shown, taken = _described(env.observation_space, model.observation_space)
        raise ConfigError(
            f"the environment shows observations {shown}, the model takes {taken}; a "
            "run's folder knows the wrappers and stacked frames that belong to it, a zip does not"
        )
    there, here = env.action_space, model.action_space
    if type(there) is not type(here) or (
        there.shape != here.shape if isinstance(here, spaces.Box) else there != here
    ):
        raise ConfigError(
            f"the environment takes actions in {there}, the model chooses from {here}; give the "
            "environment that it was trained in"
        )


def raw_of(
    normalization: VecNormalize | None, seen: Observations, space: spaces.Space[Any]
) -> Observations:
    """Return the observations that an exported policy takes, given what an environment shows.

    :param normalization: the environment's own, which holds its latest raw observations
    :param seen: its latest observations
    :param space: the policy's observation space, whose images have their channels first
    """
    raw = seen if normalization is None else _raw(normalization, seen)
    if isinstance(space, spaces.Dict):
        return {key: maybe_transpose(raw[key], part) for key, part in space.spaces.items()}
    return maybe_transpose(raw, space)


def _fits(shown: Any, taken: Any) -> bool:
    """Tell whether a policy takes an environment's observations; images may be channels last."""
    if isinstance(taken, spaces.Dict):
        return (
            isinstance(shown, spaces.Dict)
            and shown.spaces.keys() == taken.spaces.keys()
            and all(_fits(shown[key], part) for key, part in taken.spaces.items())
        )
    if isinstance(taken, spaces.Box) and isinstance(shown, spaces.Box):
        return taken.shape in (shown.shape, (*shown.shape[2:], *shown.shape[:2]))
    return bool(shown == taken)


def _described(shown: Any, taken: Any) -> tuple[str, str]:
    """Describe the difference between two spaces."""
    if isinstance(shown, spaces.Box) and isinstance(taken, spaces.Box):
        return f"of shape {shown.shape}", f"{taken.shape}"
    return f"in {shown}", f"those in {taken}"


def _raw(normalization: VecNormalize, seen: Observations) -> Observations:
    raw: Any = normalization.get_original_obs()
    if isinstance(seen, dict):
        stacked = any(np.shape(raw[key]) != np.shape(part) for key, part in seen.items())
    else:
        stacked = np.shape(raw) != np.shape(seen)
    return seen if stacked else raw


def check_recorded(observations: Observations, space: spaces.Space[Any]) -> None:
    """Reject recorded observations that are none, not finite, or not of the policy's shape.

    :raises ConfigError: if they are not valid
    """
    if not isinstance(space, spaces.Dict):
        _check_part(observations, space, "recorded observations")
        return
    keys = list(space.spaces)
    if not isinstance(observations, dict) or set(observations) != set(keys):
        got = list(observations) if isinstance(observations, dict) else type(observations).__name__
        raise ConfigError(
            f"recorded observations must be a dict of arrays with the keys {keys}, got {got}"
        )
    for key, part in space.spaces.items():
        _check_part(observations[key], part, f"recorded observations[{key!r}]")
    counts = {key: len(part) for key, part in observations.items()}
    if len(set(counts.values())) > 1:
        raise ConfigError(
            f"recorded observations must have as many rows for each key, got {counts}"
        )


def _check_part(part: Any, space: spaces.Space[Any], what: str) -> None:
    if isinstance(part, dict) or np.ndim(part) == 0 or np.shape(part)[1:] != space.shape:
        got = "a dict" if isinstance(part, dict) else f"an array of shape {np.shape(part)}"
        raise ConfigError(
            f"{what} must have a row for each, of shape {space.shape} as the policy sees "
            f"it (images channels first), got {got}"
        )
    if not len(part):
        raise ConfigError(
            f"{what} are empty; give some (record_observations makes them), or leave them out"
        )
    if not np.isfinite(part).all():
        raise ConfigError(f"{what} must be finite; some are NaN or infinite")


def check_statistics(space: spaces.Space[Any], normalization: VecNormalize) -> None:
    """Reject statistics of observations that the policy does not take.

    :raises ConfigError: if they do not fit
    """
    if wrong := mismatch(normalization, space):
        raise ConfigError(
            f"the statistics are {wrong}. Give those of the same run; if its frames were stacked "
            "after normalisation, it can be exported as 'dense' only, since no raw observation "
            "stands for the empty frames of a new episode"
        )


def has_images(space: spaces.Space[Any]) -> bool:
    """Tell whether a space consists of images or contains some."""
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return any(is_image_space(part) for part in parts)


def count_of(observations: Observations | None) -> int:
    """Return the number of observations; 0 for None."""
    if observations is None:
        return 0
    if isinstance(observations, dict):
        return len(next(iter(observations.values())))
    return len(observations)


def row_of(observations: Observations, number: int) -> Observations:
    """Return one observation, without the batch axis."""
    if isinstance(observations, dict):
        return {key: part[number] for key, part in observations.items()}
    return observations[number]


def rows_of(observations: Observations, first: int, last: int) -> Observations:
    """Return a slice of the observations."""
    if isinstance(observations, dict):
        return {key: part[first:last] for key, part in observations.items()}
    return observations[first:last]
