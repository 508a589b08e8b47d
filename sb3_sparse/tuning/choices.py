"""Names of samplers, pruners and shipped spaces, known without Optuna."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_sparse.errors import ConfigError, did_you_mean

SAMPLERS = ("grid", "tpe", "random")
PRUNERS = ("none", "median", "halving", "hyperband")
SPACES = ("paper", "wide")
SPACE_FILES = (".yml", ".yaml", ".py")


def check_choice(what: str, name: str, allowed: Sequence[str]) -> None:
    """Refuse a name that is not allowed.

    :raises ConfigError: if so
    """
    if name not in allowed:
        raise ConfigError(
            f"unknown {what} {name!r}{did_you_mean(name, allowed)}; allowed are "
            f"{', '.join(allowed)}"
        )


def check_space(what: str) -> None:
    """Refuse what is neither a shipped space nor a file.

    :raises ConfigError: if so
    """
    if what in SPACES:
        return
    path = Path(what)
    if path.suffix not in SPACE_FILES:
        raise ConfigError(
            f"unknown search space {what!r}{did_you_mean(what, SPACES)}; allowed are "
            f"{', '.join(SPACES)}, or a file of your own, .yml or .py (docs/tuning.md)"
        )
    if not path.is_file():
        raise ConfigError(f"there is no search space {path}")


def check_names(space: str, sampler: str | None, pruner: str | None) -> None:
    """Refuse names that there are not, before anything is imported that takes its time.

    :param sampler: None: the one that suits the space
    :param pruner: None: the one that suits the sampler
    :raises ConfigError: if there are any
    """
    check_space(space)
    if sampler is not None:
        check_choice("sampler", sampler, SAMPLERS)
    if pruner is not None:
        check_choice("pruner", pruner, PRUNERS)
