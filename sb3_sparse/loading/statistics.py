"""Reads the statistics that ``VecNormalize.save`` wrote."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_sparse.errors import ConfigError, CorruptStateError, Diverged
from sb3_sparse.loading.guard import reading

WHAT = "statistics of a VecNormalize"
CURE = "give what VecNormalize.save wrote of the same run, e.g. --vecnormalize vecnormalize.pkl"


def read_statistics(path: Path) -> VecNormalize:
    """Read the VecNormalize in a file; it has no environments yet.

    This unpickles the file, as SB3 does, so the file must be trusted.

    :raises ConfigError: if the file cannot be opened
    :raises CorruptStateError: if the file holds something else
    :raises Diverged: if a mean or variance is not finite
    """
    with reading(path, WHAT, CURE):
        found = pickle.loads(path.read_bytes())
    if not isinstance(found, VecNormalize):
        raise CorruptStateError(
            f"{path} holds a {type(found).__name__} where {WHAT} should be; {CURE}"
        )
    with reading(path, WHAT, CURE):
        parts = _parts(found)
        for one in parts.values():
            if one.mean.dtype.kind != "f" or one.mean.shape != one.var.shape:
                raise CorruptStateError(f"{path} is damaged: its mean does not match its variance")
        bool(found.norm_obs), bool(found.norm_reward)
        float(found.epsilon), float(found.clip_obs)
        finite = all(np.isfinite([*one.mean.flat, *one.var.flat]).all() for one in parts.values())
    if not finite:
        raise Diverged(
            f"the statistics in {path} are not finite: the environment showed NaN or infinite "
            "observations in training. Fix the environment and train again"
        )
    return found


def load_statistics(path: Path, envs: VecEnv) -> VecNormalize:
    """Normalise environments by the statistics in a file.

    :raises ConfigError: as :func:`read_statistics`, or if the observations do not match
    """
    found = read_statistics(path)
    if wrong := mismatch(found, envs.observation_space):
        raise ConfigError(f"the statistics in {path} are {wrong}; {CURE}")
    with reading(path, WHAT, CURE):
        found.set_venv(envs)
    return found


def mismatch(normalize: VecNormalize, space: spaces.Space[Any]) -> str:
    """Describe how the statistics of observations differ from a space; empty if they match."""
    taken = {"": space.shape}
    if isinstance(space, spaces.Dict):
        taken = {key: part.shape for key, part in space.items()}
    seen = {key: one.mean.shape for key, one in _parts(normalize).items()}
    if not normalize.norm_obs or (seen and all(taken.get(key) == seen[key] for key in seen)):
        return ""
    has, wants = (", ".join(map(str, shapes.values())) or "unknown" for shapes in (seen, taken))
    return f"for observations of shape {has}, but those here have shape {wants}"


def _parts(normalize: VecNormalize) -> dict[str, RunningMeanStd]:
    """Return statistics of observations by part of a Dict; empty if they are not normalised."""
    rms: Any = getattr(normalize, "obs_rms", None)
    if rms is None or not normalize.norm_obs:
        return {}
    return dict(rms) if isinstance(rms, dict) else {"": rms}
