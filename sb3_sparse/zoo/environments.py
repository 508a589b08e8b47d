"""Which environments there are, whose package brings one, and what is missing when one is not."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_sparse.errors import ConfigError, MissingExtra, did_you_mean
from sb3_sparse.policies.registry import registered


def register_atari() -> bool:
    """Register the Atari games where ale-py is installed; whether it is."""
    if importlib.util.find_spec("ale_py") is None:
        return False
    import ale_py

    gym.register_envs(ale_py)
    return True


def package_names(given: Any) -> tuple[str, ...]:
    """Names of packages that register environments or algorithms.

    :param given: as ``--gym-packages`` and files give them: a name, a list of names, or None
    :raises ConfigError: if it is something else
    """
    names = [given] if isinstance(given, str) else [] if given is None else given
    if not isinstance(names, (list, tuple)) or not all(_is_module(name) for name in names):
        raise ConfigError(
            "gym_packages must be names of modules that register environments or algorithms, e.g. "
            f"my_envs or my_envs.maze (no path of a file), got {given!r}"
        )
    return tuple(dict.fromkeys(names))


def _is_module(name: Any) -> bool:
    return isinstance(name, str) and all(part.isidentifier() for part in name.split("."))


def plain_id(env_id: str, packages: Sequence[str] = ()) -> tuple[str, tuple[str, ...]]:
    """An id without its package, and the packages with it.

    Gymnasium's ``package:Env-v0`` is ``Env-v0`` of a package that is imported first. Folders and
    configs know the plain id.

    :param env_id: e.g. ``"CartPole-v1"`` or ``"my_envs:Maze-v0"``
    :param packages: that are imported anyway
    :raises ConfigError: if what stands before the colon is no name of a module
    """
    package, colon, name = env_id.partition(":")
    if not colon:
        return env_id, tuple(packages)
    if not _is_module(package) or not name or ":" in name:
        raise ConfigError(
            f"the environment {env_id!r} is neither an id nor package:Id, e.g. my_envs:Maze-v0"
        )
    return name, package_names([*packages, package])


def import_packages(names: Iterable[str]) -> None:
    """Import packages, so that they register their environments and algorithms.

    :raises ConfigError: if one is not there, or fails
    """
    for name in names:
        # The user's code may name SparsePolicy, whose registration the command line puts off.
        registered()
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if not error.name or not (name == error.name or name.startswith(f"{error.name}.")):
                raise _failed(name, error) from error
            root = Path(name.partition(".")[0])
            here = root.is_dir() or root.with_suffix(".py").is_file()
            raise ConfigError(
                f"there is no package {name!r} to import environments or algorithms from; install "
                "it, or put the folder that it lies in on PYTHONPATH"
                + (" (it lies in this one: PYTHONPATH=. before the command)" if here else "")
            ) from error
        except Exception as error:
            raise _failed(name, error) from error


def _failed(name: str, error: Exception) -> ConfigError:
    return ConfigError(f"the package {name!r} cannot be imported: {type(error).__name__}: {error}")


def known_environment(env_id: str) -> None:
    """Refuse an environment that is not there.

    :raises ConfigError: if Gymnasium has none of this id
    :raises MissingExtra: if it is an Atari game, and ale-py or OpenCV is not installed
    """
    has_atari = register_atari()
    if suite_of(env_id) == ATARI and not (has_atari and importlib.util.find_spec("cv2")):
        raise MissingExtra(env_id, "atari")
    if env_id not in gym.registry:
        raise ConfigError(
            f"unknown environment {env_id!r}"
            + (did_you_mean(env_id, gym.registry) or "; give a Gymnasium id")
            + "; --gym-packages names a module that registers environments of your own"
            + ("" if has_atari else " (Atari games need sb3-sparse[atari])")
        )


def is_atari(env_id: str) -> bool:
    """Whether it is an Atari game, told as rl-zoo tells it."""
    return "AtariEnv" in str(gym.registry[env_id].entry_point)


ATARI = "Atari"
CLASSIC_CONTROL = ("CartPole", "Acrobot", "MountainCar", "MountainCarContinuous", "Pendulum")
MUJOCO = (
    "Ant",
    "HalfCheetah",
    "Hopper",
    "Humanoid",
    "HumanoidStandup",
    "InvertedDoublePendulum",
    "InvertedPendulum",
    "Pusher",
    "Reacher",
    "Swimmer",
    "Walker2d",
)


def game_of(env_id: str) -> str:
    """Name of a task without its version, e.g. ``"Pong"`` of ``"ALE/Pong-v5"``."""
    name = re.sub(r"-v\d+$", "", env_id.split("/")[-1])
    return re.sub(r"(-ram)?(NoFrameskip|Deterministic)?$", "", name)


def suite_of(env_id: str) -> str:
    """The benchmark that a task belongs to, told by its name: it need not be registered."""
    if env_id.startswith("ALE/") or "NoFrameskip" in env_id or "Deterministic" in env_id:
        return ATARI
    if game_of(env_id) in CLASSIC_CONTROL:
        return "classic control"
    return "MuJoCo" if game_of(env_id) in MUJOCO else "other tasks"
