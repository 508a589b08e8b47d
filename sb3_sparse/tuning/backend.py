"""The one place that asks whether Optuna is there."""

from __future__ import annotations

import warnings

from sb3_sparse.errors import MissingExtra

try:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial, Trial, TrialState
except ImportError as error:
    raise MissingExtra("tuning", "tune") from error

# Lists are good choices too, e.g. of net_arch: they are written to storages as they are.
warnings.filterwarnings("ignore", message="Choices for a categorical distribution should be")
warnings.filterwarnings("ignore", message=".* contains a value with the type of .*GridSampler")
optuna.logging.set_verbosity(optuna.logging.WARNING)

__all__ = ["BaseDistribution", "BaseStorage", "FrozenTrial", "Trial", "TrialState", "optuna"]
