"""Finds environments, the packages that register them, and what to install if one is missing."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_sparse.errors import ConfigError, MissingExtra, did_you_mean, place_of
from sb3_sparse.policies.registry import registered
from sb3_sparse.zoo.deepmind import PREFIX, register_dm_control

ATARI = "Atari"
DM_CONTROL = "DeepMind Control"
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
_said: set[str] = set()


def register_atari() -> bool:
    """Register the Atari games if ale-py is installed, and return whether it is."""
    if importlib.util.find_spec("ale_py") is None:
        return False
    import ale_py

    gym.register_envs(ale_py)
    return True


def package_names(given: Any) -> tuple[str, ...]:
    """Return the names of packages that register environments or algorithms.

    :param given: a name, a list of names, or None, as from ``--gym-packages`` or a file
    :raises ConfigError: for anything else
    """
    names = [given] if isinstance(given, str) else [] if given is None else given
    if not isinstance(names, (list, tuple)) or not all(_is_module(name) for name in names):
        raise ConfigError(
            "gym_packages must be names of modules that register environments or algorithms, e.g. "
            f"my_envs or my_envs.maze (not a file path), got {given!r}"
        )
    return tuple(dict.fromkeys(names))


def _is_module(name: Any) -> bool:
    return isinstance(name, str) and all(part.isidentifier() for part in name.split("."))


def plain_id(env_id: str, packages: Sequence[str] = ()) -> tuple[str, tuple[str, ...]]:
    """Separate an id from its package, and add that package to the others.

    Gymnasium imports the package of ``package:Env-v0`` before it makes ``Env-v0``. Folders and
    configs use the plain id.

    :param env_id: e.g. ``"CartPole-v1"`` or ``"my_envs:Maze-v0"``
    :param packages: the other packages
    :raises ConfigError: if the text before the colon is not the name of a module
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

    :raises ConfigError: if one is missing or raises
    """
    for name in names:
        # User code may name SparsePolicy, whose registration the command line defers.
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
                "it, or put the folder that contains it on PYTHONPATH"
                + (" (the current one does: put PYTHONPATH=. before the command)" if here else "")
            ) from error
        except Exception as error:
            raise _failed(name, error) from error


def _failed(name: str, error: Exception) -> ConfigError:
    return ConfigError(
        f"the package {name!r} cannot be imported: {type(error).__name__}: {error}{place_of(error)}"
    )


def register_suite(env_id: str) -> bool:
    """Register the suite of an environment, and return whether all that it needs is installed."""
    has_atari = register_atari()
    suite = suite_of(env_id)
    if suite == DM_CONTROL:
        return register_dm_control()
    return suite != ATARI or (has_atari and importlib.util.find_spec("cv2") is not None)


def known_environment(env_id: str) -> None:
    """Raise if an environment does not exist.

    :raises ConfigError: if Gymnasium has no environment of this id
    :raises MissingExtra: if it is an Atari game, and ale-py or OpenCV is not installed, or a task
        of dm_control, and it or shimmy is not installed
    """
    if not register_suite(env_id):
        raise MissingExtra(env_id, "atari" if suite_of(env_id) == ATARI else "dmc")
    if env_id not in gym.registry:
        raise ConfigError(
            f"unknown environment {env_id!r}"
            + (did_you_mean(env_id, gym.registry) or "; give a Gymnasium id")
            + "; one of your own is module:Id, e.g. my_envs:Maze-v0, or --gym-packages names its "
            "module" + ("" if register_atari() else " (Atari games need sb3-sparse[atari])")
        )


def is_atari(env_id: str) -> bool:
    """Whether an environment is an Atari game, by rl-zoo's rule."""
    return "AtariEnv" in str(gym.registry[env_id].entry_point)


def game_of(env_id: str) -> str:
    """Return a task's name without its version, e.g. ``"Pong"`` for ``"ALE/Pong-v5"``."""
    name = re.sub(r"-v\d+$", "", env_id.split("/")[-1])
    return re.sub(r"(-ram)?(NoFrameskip|Deterministic)?$", "", name)


def suite_of(env_id: str) -> str:
    """Return a task's benchmark by its name; the task need not be registered."""
    if env_id.startswith("ALE/") or "NoFrameskip" in env_id or "Deterministic" in env_id:
        return ATARI
    if env_id.startswith(PREFIX):
        return DM_CONTROL
    if game_of(env_id) in CLASSIC_CONTROL:
        return "classic control"
    return "MuJoCo" if game_of(env_id) in MUJOCO else "other tasks"


@contextmanager
def mujoco_warns_once(env_id: str) -> Iterator[None]:
    """Print each of MuJoCo's warnings once per process, and write none to a file.

    Outside, MuJoCo prints them all and writes ``MUJOCO_LOG.TXT`` into the current folder.

    :param env_id: environment to make; MuJoCo is imported only if this is one of Gymnasium's own
        MuJoCo tasks
    """
    entry_point = str(getattr(gym.registry.get(env_id), "entry_point", ""))
    mujoco: Any = sys.modules.get("mujoco")
    if mujoco is None and "mujoco" in entry_point:
        with suppress(ImportError):  # Gymnasium reports what is missing
            mujoco = importlib.import_module("mujoco")
    if mujoco is None:
        yield
        return

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(_say)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _say(message: str) -> None:
    message = message.strip()
    if message not in _said:
        _said.add(message)
        print(f"MuJoCo warns: {message}", file=sys.stderr)
