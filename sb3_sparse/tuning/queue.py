"""Storages that give out the trials that wait in a study, and make none."""

from __future__ import annotations

from collections.abc import Callable, Container

from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, TrialState, optuna
from sb3_sparse.tuning.samplers import TICKET

StaleCallback = Callable[["optuna.Study", FrozenTrial], None]


class QueueEmpty(Exception):
    """There is no trial left to take."""


class FromQueue(BaseStorage):
    """Gives out the trials that wait in a study, and never makes one for a worker that asks.

    A study holds its whole budget as waiting trials. Every storage takes one in a single atomic
    step, so no trial is trained twice, whatever the sampler and however many workers there are.
    """

    def create_new_trial(self, study_id: int, template_trial: FrozenTrial | None = None) -> int:
        """As in Optuna, but only with a template.

        :raises QueueEmpty: without
        """
        if template_trial is None:
            raise QueueEmpty
        return super().create_new_trial(study_id, template_trial)  # type: ignore[safe-super]

    def get_all_trials(
        self,
        study_id: int,
        deepcopy: bool = True,
        states: Container[TrialState] | None = None,
    ) -> list[FrozenTrial]:
        """As in Optuna, but those that wait come in the order that they were planned in.

        So what was lost or interrupted is trained before what has not been begun.
        """
        trials = super().get_all_trials(study_id, deepcopy, states)  # type: ignore[safe-super]
        if states != (TrialState.WAITING,):
            return trials
        return sorted(trials, key=lambda trial: trial.system_attrs.get(TICKET, trial.number))
