"""The private names of Optuna that storages need; a release of Optuna may change them."""

from __future__ import annotations

from abc import abstractmethod

from optuna.storages import _CachedStorage as CachedStorage
from optuna.storages._heartbeat import BaseHeartbeat

from sb3_sparse.tuning.backend import FrozenTrial

__all__ = ["CHECKED", "CachedStorage", "SignsOfLife", "id_of"]
CHECKED = "5.0.0"
"""The version of Optuna that these names were checked against."""


def id_of(trial: FrozenTrial) -> int:
    """Return the number by which storages know a trial, over all studies."""
    return trial._trial_id


class SignsOfLife(BaseHeartbeat):
    """A storage whose workers give signs of life, so that Optuna finds trials that were lost."""

    @abstractmethod
    def stale_trials(self, study_id: int) -> list[FrozenTrial]:
        """Return the running trials whose workers have been silent for too long."""

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        return [id_of(trial) for trial in self.stale_trials(study_id)]
