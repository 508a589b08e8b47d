"""Checks and completes the wrappers that settings name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.arguments import import_path

CUT_EPISODES = "sb3_sparse.wrappers.CutEpisodes"


def check_wrappers(settings: Mapping[str, Any]) -> None:
    """Reject anything but wrappers: calling whatever a file names could run any code.

    :raises ConfigError: naming the first that is not a wrapper
    """
    for name, kind in (("env_wrapper", gym.Wrapper), ("vec_env_wrapper", VecEnvWrapper)):
        given = settings.get(name) or []
        for one in _listed(given):
            path = one if isinstance(one, str) else next(iter(one))
            found = import_path(path)
            if not (isinstance(found, type) and issubclass(found, kind)):
                raise ConfigError(
                    f"{name} {path} is not a subclass of {kind.__module__}.{kind.__name__}; "
                    "make it one"
                )


def with_env_wrappers(
    settings: Mapping[str, Any], wrappers: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """Return settings with further wrappers, and with CutEpisodes outside of all if there are any.

    :param wrappers: each maps a path to its arguments, as in rl-zoo's ``env_wrapper``
    """
    named = [*_listed(settings.get("env_wrapper") or []), *wrappers]
    return {**settings, "env_wrapper": [*named, CUT_EPISODES]} if named else dict(settings)


def _listed(given: Any) -> list[Any]:
    return given if isinstance(given, list) else [given]
