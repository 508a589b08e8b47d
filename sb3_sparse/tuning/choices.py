"""Names of samplers, pruners and shipped spaces, which are known without Optuna."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_sparse.errors import ConfigError, did_you_mean

SAMPLERS = ("grid", "tpe", "random")
PRUNERS = ("none", "median", "halving", "hyperband")
SPACES = ("paper", "wide")
SPACE_FILES = (".yml", ".yaml", ".py")


def check_choice(what: str, name: str, allowed: Sequence[str]) -> None:
    """Check that a name is allowed.

    :raises ConfigError: if it is not
    """
    if name not in allowed:
        raise ConfigError(
            f"unknown {what} {name!r}{did_you_mean(name, allowed)}; allowed are "
            f"{', '.join(allowed)}"
        )


def check_space_name(name: str) -> None:
    """Check that a name is that of a shipped space or of a file.

    :raises ConfigError: if it is neither
    """
    if name in SPACES:
        return
    path = Path(name)
    if path.suffix not in SPACE_FILES:
        raise ConfigError(
            f"unknown search space {name!r}{did_you_mean(name, SPACES)}; allowed are "
            f"{', '.join(SPACES)}, or a file of your own, .yml or .py (docs/tuning.md)"
        )
    if not path.is_file():
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
