"""What a VecNormalize has seen, as ``VecNormalize.save`` wrote it."""

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
    """The VecNormalize in a file; it has no environments yet.

    Unpickles the file, as SB3 does: it must come from somebody who is trusted.

    :raises ConfigError: if it cannot be opened
    :raises CorruptStateError: if it holds something else
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
                raise CorruptStateError(f"{path} is damaged: its mean does not suit its variance")
        bool(found.norm_obs), bool(found.norm_reward)
        float(found.epsilon), float(found.clip_obs)
        finite = all(np.isfinite([*one.mean.flat, *one.var.flat]).all() for one in parts.values())
    if not finite:
        raise Diverged(
            f"the statistics in {path} are not finite: the environment showed NaN or infinite "
            "observations in training. Mend the environment and train anew"
        )
    return found


def load_statistics(path: Path, envs: VecEnv) -> VecNormalize:
    """Environments that are normalised as a file says.

    :raises ConfigError: as :func:`read_statistics`, or if it is of other observations
    """
    found = read_statistics(path)
    space = envs.observation_space
    shown = {"": space.shape}
    if isinstance(space, spaces.Dict):
        shown = {key: part.shape for key, part in space.items()}
    seen = {key: one.mean.shape for key, one in _parts(found).items()}
    fits = all(shown.get(key) == shape for key, shape in seen.items())
    if found.norm_obs and not (fits and seen):
        raise ConfigError(
            f"the statistics in {path} are of observations of shape "
            f"{', '.join(map(str, seen.values())) or 'unknown'}, the environment shows "
            f"{', '.join(map(str, shown.values()))}; {CURE}"
        )
    with reading(path, WHAT, CURE):
        found.set_venv(envs)
    return found


def _parts(normalize: VecNormalize) -> dict[str, RunningMeanStd]:
    """Statistics of the observations, by part of a Dict; empty where they are not normalised."""
    rms: Any = getattr(normalize, "obs_rms", None)
    if rms is None or not normalize.norm_obs:
        return {}
    return dict(rms) if isinstance(rms, dict) else {"": rms}
