"""Checks the wrappers that a file names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.arguments import import_path


def check_wrappers(settings: Mapping[str, Any]) -> None:
    """Reject anything but wrappers: calling whatever a file names could run any code.

    :raises ConfigError: naming the first that is not a wrapper
    """
    for name, kind in (("env_wrapper", gym.Wrapper), ("vec_env_wrapper", VecEnvWrapper)):
        given = settings.get(name) or []
        for one in given if isinstance(given, list) else [given]:
            path = one if isinstance(one, str) else next(iter(one))
            found = import_path(path)
            if not (isinstance(found, type) and issubclass(found, kind)):
                raise ConfigError(
                    f"{name} {path} is not a subclass of {kind.__module__}.{kind.__name__}; "
                    "make it one"
                )
