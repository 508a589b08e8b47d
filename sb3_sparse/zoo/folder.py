"""A run's folder as rl-zoo lays it out: what it was started with, its settings, its models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.loading.text import read_json
from sb3_sparse.loading.zooyaml import check_built, read_zoo_yaml
from sb3_sparse.zoo.environments import package_names, plain_id

VECNORMALIZE = "vecnormalize.pkl"
CONFIG = "config.yml"
ARGUMENTS = "args.yml"
OF_ENVIRONMENT = ("env_wrapper", "vec_env_wrapper", "frame_stack", "env_kwargs", "normalize")
"""The settings that decide how a run's environments are made."""
RESTORE = "restore it, or copy the zip out of the folder and give it with --env and --vecnormalize"


def new_run_folder(parent: Path, env_name: str) -> Path:
    """Make and return ``parent/<env>_<n>`` with the next free number."""
    parent.mkdir(parents=True, exist_ok=True)
    while True:
        taken = [
            int(number)
            for folder in parent.glob(f"{env_name}_*")
            if (number := folder.name.removeprefix(f"{env_name}_")).isdigit()
        ]
        folder = parent / f"{env_name}_{max(taken, default=0) + 1}"
        try:
            folder.mkdir()
        except FileExistsError:  # another run was quicker
            continue
        return folder


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run."""
    return len(list(folder.glob(f"*/{ARGUMENTS}"))) == 1


def arguments_of(folder: Path) -> dict[str, Any]:
    """What a run was started with, from the file that rl-zoo writes.

    :raises ConfigError: if there is no run
    :raises CorruptStateError: if the file is damaged
    """
    files = list(folder.glob(f"*/{ARGUMENTS}"))
    compression = folder / "compress.json"
    if not files and compression.is_file():
        cure = "give its command again with another --out"
        if read_json(compression, "record of a compression", cure).get("finished"):
            raise ConfigError(f"{folder} is no run's folder; give the zip in it")
        raise ConfigError(
            f"the compression in {folder} is not finished; give its command again, and it goes on"
        )
    if len(files) != 1:
        raise ConfigError(
            f"there is no run in {folder}; give the run's own folder, e.g. "
            "logs/sac/HalfCheetah-v5_1"
        )
    (path,) = files
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
    """The environment's plain id in a run's arguments, and the modules that register it.

    :param arguments: as :func:`arguments_of` returns them
    """
    packages = package_names(arguments.get("gym_packages"))
    env_id = arguments.get("env")
    return (None, packages) if env_id is None else plain_id(str(env_id), packages)


def params_of(folder: Path, env_id: str) -> Path:
    """The folder of a run's ``config.yml`` and normalisation."""
    return folder / env_id.replace("/", "-")


def environment_settings(params: Path) -> dict[str, Any]:
    """How a run's environments are made: wrappers, stacking, arguments, whether normalised.

    :param params: folder of the run's ``config.yml``
    :return: those of :data:`OF_ENVIRONMENT` that the file has, ``normalize`` as a truth value
    :raises ConfigError: if there is no such file
    :raises CorruptStateError: if it is damaged
    """
    path = params / CONFIG
    if not path.is_file():
        raise ConfigError(
            f"{path} is missing, which says how the run's environment was wrapped, stacked and "
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


def model_in(folder: Path, env_id: str, best: bool) -> Path:
    """The last or best policy in a run's folder.

    :raises ConfigError: if there is none
    """
    path = folder / ("best_model.zip" if best else f"{env_id.replace('/', '-')}.zip")
    if not path.is_file():
        models = ", ".join(sorted(file.name for file in folder.glob("*.zip"))) or "none"
        why = (
            "there is a best policy after the first evaluation at the sparsity asked for"
            if best
            else "a run that was killed has its last policy after sb3-sparse train --resume"
        )
        raise ConfigError(f"{folder} has no {path.name} (its models: {models}): {why}")
    return path


def zip_path(path: Path) -> Path:
    """The path with the suffix that SB3 adds, where it was left out."""
    if not path.name or path.suffix:
        return path
    with_suffix = path.with_suffix(".zip")
    return with_suffix if with_suffix.is_file() else path


def _names(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


def _wrappers(value: Any) -> bool:
    """Whether it is a dotted path, a path with its arguments, or a list of these."""
    return all(
        isinstance(one, str)
        or (_names(one) and len(one) == 1 and all(_names(given) for given in one.values()))
        for one in (value if isinstance(value, list) else [value])
    )
