"""Names of samplers, pruners and shipped spaces, which are known without Optuna."""

from __future__ import annotations

from pathlib import Path

from sb3_sparse.errors import ConfigError, check_choice

SAMPLERS = ("grid", "tpe", "random")
PRUNERS = ("none", "median", "halving", "hyperband")
SPACES = ("paper", "wide")
SPACE_FILES = (".yml", ".yaml", ".py")


def check_space_name(name: str) -> None:
    """Check that a name is that of a shipped space or of a file.

    :raises ConfigError: if it is neither
    """
    path = Path(name)
    if path.suffix not in SPACE_FILES:
        file = ", or a file of your own, .yml or .py (docs/tuning.md)"
        check_choice("search space", name, SPACES, file)
    elif not path.is_file():
        raise ConfigError(f"there is no search space {path}")


def check_names(space: str, sampler: str | None, pruner: str | None) -> None:
    """Check the names of a command before any slow import.

    :param sampler: None: the one that suits the space
    :param pruner: None: the one that suits the sampler
    :raises ConfigError: for an unknown name
    """
    check_space_name(space)
    if sampler is not None:
        check_choice("sampler", sampler, SAMPLERS)
    if pruner is not None:
        check_choice("pruner", pruner, PRUNERS)
