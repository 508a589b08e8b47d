"""The one place that asks whether Optuna is there."""

from __future__ import annotations

from sb3_sparse.errors import MissingExtra

try:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial, Trial, TrialState
except ImportError as error:
    raise MissingExtra("tuning", "tune") from error

optuna.logging.set_verbosity(optuna.logging.WARNING)

__all__ = ["BaseDistribution", "BaseStorage", "FrozenTrial", "Trial", "TrialState", "optuna"]
