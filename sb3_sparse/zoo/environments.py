"""Which environments there are, and what is missing when one is not."""

from __future__ import annotations

import importlib.util

import gymnasium as gym

from sb3_sparse.errors import ConfigError, MissingExtra, did_you_mean


def register_atari() -> bool:
    """Register the Atari games where ale-py is installed; whether it is."""
    if importlib.util.find_spec("ale_py") is None:
        return False
    import ale_py

    gym.register_envs(ale_py)
    return True


def known_environment(env_id: str) -> None:
    """Refuse an environment that is not there.

    :raises ConfigError: if Gymnasium has none of this id
    :raises MissingExtra: if it is an Atari game, and ale-py or OpenCV is not installed
    """
    looks_atari = "NoFrameskip" in env_id or env_id.startswith("ALE/")
    has_atari = register_atari()
    if looks_atari and not (has_atari and importlib.util.find_spec("cv2")):
        raise MissingExtra(env_id, "atari")
    if env_id not in gym.registry:
        raise ConfigError(
            f"unknown environment {env_id!r}"
            + (did_you_mean(env_id, gym.registry) or "; give a Gymnasium id")
            + ("" if has_atari else " (Atari games need sb3-sparse[atari])")
        )


def is_atari(env_id: str) -> bool:
    """Whether it is an Atari game, told as rl-zoo tells it."""
    return "AtariEnv" in str(gym.registry[env_id].entry_point)
