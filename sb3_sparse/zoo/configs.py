"""The YAML files with the settings of every method and algorithm."""

from __future__ import annotations

from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.topology import method_names
from sb3_sparse.zoo.strictyaml import parse

DENSE = "dense"

PACKAGE = Path(__file__).parent.parent
ROOTS = (PACKAGE / "zoo_hparams", PACKAGE.parent / "zoo_hparams")  # in a wheel; in a clone
METHODS = (DENSE, "prune", "static", "set", "rigl")
"""What the paper compares; there are settings for every algorithm."""


def config_root() -> Path:
    """Return the folder of the shipped configs."""
    return next(root for root in ROOTS if root.is_dir())


def config_folders() -> list[str]:
    """Return the folders of the shipped configs: those of methods, and presets."""
    found = {path.name for path in config_root().iterdir() if path.is_dir()}
    return [*METHODS, *sorted(found - set(METHODS))]


def is_preset(name: str) -> bool:
    """Whether a name is that of a shipped folder, and of no method.

    A preset's configs hold what a method's name cannot say: a method for each network, or further
    callbacks.
    """
    return name not in (DENSE, *method_names()) and name in config_folders()


def config_path(method: str, algo: str) -> Path:
    """Return the YAML file of a method and an algorithm, in rl-zoo's form.

    :param method: one of :func:`config_folders`: a method or a preset
    :param algo: algorithm, e.g. ``"sac"``, or another file in that folder, e.g. ``"dqn_impala"``
    :raises ConfigError: if no such file is shipped
    """
    folders = config_folders()
    if method not in folders:
        raise ConfigError(
            f"no config is shipped for method {method!r}, only for {', '.join(folders)}"
            f"{did_you_mean(method, folders)}. Or write one and pass it as --conf-file "
            "(docs/configs.md)"
        )
    path = config_root() / method / f"{algo}.yml"
    if not path.is_file():
        names = sorted(file.stem for file in path.parent.glob("*.yml"))
        exists = any(config_root().glob(f"*/{algo}.yml"))
        guess = "" if exists else did_you_mean(algo, names)
        raise ConfigError(
            f"no config is shipped for {algo!r} with method {method!r}, only for {', '.join(names)}"
            f"{guess}. Or write one and pass it as --conf-file (docs/configs.md)"
        )
    return path


def entries_of(folder: str) -> list[dict[str, Any]]:
    """Return the settings of all environments in all files of a shipped folder."""
    files = sorted((config_root() / folder).glob("*.yml"))
    return [entry for file in files for entry in read_yaml(file).values()]


def read_yaml(path: Path, what: str = "environment ids to settings") -> dict[str, Any]:
    """Return the mapping in a YAML file.

    :param what: what the file maps, for messages
    :raises ConfigError: if the file is missing, unreadable or not a mapping, or repeats a key
    """
    return deepcopy(_read(path, what))


def _read(path: Path, what: str = "environment ids to settings") -> dict[str, Any]:
    if path.is_dir():
        raise ConfigError(f"{path} is a folder; give a YAML file in it")
    if not path.is_file():
        raise ConfigError(f"there is no config file {path}")
    try:
        content = _parsed(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not UTF-8 text ({error}); save it as UTF-8") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error
    except ConfigError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path} must map {what}, got {content!r}")
    return content


@lru_cache(maxsize=64)
def _parsed(text: str) -> Any:
    """Parse a text once, since a study asks for the same files thousands of times."""
    return parse(text)


def entry_of(path: Path, env_id: str, atari: bool) -> dict[str, Any]:
    """Return a copy of an environment's settings, looked up as rl-zoo does.

    :param path: YAML file
    :param env_id: environment
    :param atari: whether it is an Atari game, to which the key ``atari`` applies
    :raises ConfigError: if the file has no settings for this environment
    """
    content = _read(path)
    shared = "atari" if atari else "default"
    key = env_id if env_id in content else shared
    if key not in content:
        others = "Atari game" if atari else "environment"
        raise ConfigError(
            f"{path} has no settings for {env_id!r}; its keys are {', '.join(map(str, content))}"
            f"{did_you_mean(env_id, map(str, content))}. Add the key {env_id!r}, or `{shared}` for "
            f"every {others} without its own key"
        )
    entry = content[key]
    if not isinstance(entry, dict):
        raise ConfigError(f"{key!r} in {path} must be a mapping of settings, got {entry!r}")
    return deepcopy(entry)


def evaluation_of(algo: str, env_id: str, atari: bool) -> dict[str, int]:
    """Return how a run is evaluated: ``eval_freq`` (environment steps) and ``eval_episodes``."""
    suites = _read(config_root() / "evaluation.yml")
    suite = suites.get(algo, suites["default"])
    shared = "atari" if atari else "default"
    return {name: int(value) for name, value in suite.get(env_id, suite[shared]).items()}
