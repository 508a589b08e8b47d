"""Optuna, an optional dependency: every module of the package imports it from here."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from sb3_sparse.errors import MissingExtra

try:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial, Trial, TrialState
except ImportError as error:
    raise MissingExtra("tuning", "tune") from error

__all__ = [
    "BaseDistribution",
    "BaseStorage",
    "FrozenTrial",
    "Trial",
    "TrialState",
    "optuna",
    "quiet_optuna",
]


@contextmanager
def quiet_optuna() -> Iterator[None]:
    """Make Optuna log warnings only, within the block.

    It also silences Optuna's warning that a list, e.g. of net_arch, is not a good choice: storages
    write lists as they are.
    """
    level = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(max(level, optuna.logging.WARNING))
    try:
        with warnings.catch_warnings():
            for message in (
                "Choices for a categorical distribution should be",
                ".* contains a value with the type of .*GridSampler",
            ):
                warnings.filterwarnings("ignore", message=message)
            yield
    finally:
        optuna.logging.set_verbosity(level)
