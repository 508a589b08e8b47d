"""Reads the two files in which rl-zoo notes how a run was made: its arguments and settings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.loading.zooyaml import check_built, read_zoo_yaml
from sb3_sparse.zoo.environments import package_names, plain_id

CONFIG = "config.yml"
ARGUMENTS = "args.yml"
OF_ENVIRONMENT = ("env_wrapper", "vec_env_wrapper", "frame_stack", "env_kwargs", "normalize")
"""The settings that decide how a run's environments are made."""
RESTORE = "restore it, or copy the zip out of the folder and give it with --env and --vecnormalize"


def read_arguments(path: Path) -> dict[str, Any]:
    """Read the arguments that a run was started with.

    :param path: the run's ``args.yml``
    :return: ``algo`` and ``env`` are names, ``env_kwargs`` maps names to values or is None or
        missing; the others as they are
    :raises CorruptStateError: if the file is damaged
    """
    arguments = read_zoo_yaml(path, RESTORE)
    for name in ("algo", "env"):
        if not isinstance(arguments.get(name), str):
            raise CorruptStateError(
                f"{path} is damaged: {name} must be a name, got {arguments.get(name)!r}; {RESTORE}"
            )
    kwargs = arguments.get("env_kwargs")
    check_built(kwargs, f"env_kwargs in {path}")
    if kwargs is not None and not _names(kwargs):
        raise CorruptStateError(
            f"{path} is damaged: env_kwargs must map names to values, got {kwargs!r}; {RESTORE}"
        )
    return arguments


def environment_in(arguments: Mapping[str, Any]) -> tuple[str | None, tuple[str, ...]]:
    """Return the environment's plain id in a run's arguments, and the modules that register it.

    :param arguments: as :func:`read_arguments` returns them
    """
    packages = package_names(arguments.get("gym_packages"))
    env_id = arguments.get("env")
    return (None, packages) if env_id is None else plain_id(str(env_id), packages)


def environment_settings(parameters: Path) -> dict[str, Any]:
    """Read how a run's environments are made: wrappers, stacking, arguments, normalisation.

    :param parameters: folder of the run's ``config.yml``
    :return: the settings of :data:`OF_ENVIRONMENT` that the file has, ``normalize`` as a bool
    :raises ConfigError: if there is no such file
    :raises CorruptStateError: if the file is damaged
    """
    path = parameters / CONFIG
    if not path.is_file():
        raise ConfigError(
            f"{path} is missing, which records how the run's environment was wrapped, stacked and "
            f"normalised; {RESTORE}"
        )
    content = read_zoo_yaml(path, RESTORE)
    settings = {
        name: content[name] for name in OF_ENVIRONMENT if content.get(name) not in (None, 0)
    }
    check_built(settings, str(path))
    stack = settings.get("frame_stack", 1)
    allowed = {
        "frame_stack": type(stack) is int and 1 <= stack <= 1000,
        "env_kwargs": _names(settings.get("env_kwargs", {})),
        **{name: _wrappers(settings.get(name, [])) for name in ("env_wrapper", "vec_env_wrapper")},
    }
    for name, fits in allowed.items():
        if not fits:
            raise CorruptStateError(
                f"{path} is damaged: {name} cannot be {settings[name]!r}; {RESTORE}"
            )
    settings["normalize"] = bool(settings.get("normalize", False))
    return settings


def _names(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


def _wrappers(value: Any) -> bool:
    """Whether a value is a dotted path, a path with its arguments, or a list of these."""
    return all(
        isinstance(one, str)
        or (_names(one) and len(one) == 1 and all(_names(given) for given in one.values()))
        for one in (value if isinstance(value, list) else [value])
    )
