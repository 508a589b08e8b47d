"""Storages that hand out waiting trials only."""

from __future__ import annotations

from collections.abc import Callable, Container

from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, TrialState, optuna
from sb3_sparse.tuning.samplers import TICKET

StaleCallback = Callable[["optuna.Study", FrozenTrial], None]


class QueueEmpty(Exception):
    """No trial waits any more."""


class FromQueue(BaseStorage):
    """A storage that hands out waiting trials, and never makes one for a worker that asks.

    A search holds its whole budget as waiting trials. Every storage takes one in a single atomic
    step, so no trial is trained twice, with any sampler and any number of workers.
    """

    def create_new_trial(self, study_id: int, template_trial: FrozenTrial | None = None) -> int:
        """Make a trial from a template, as Optuna does.

        :raises QueueEmpty: without a template, when a worker asks and no trial waits
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
        """Return trials as Optuna does, but waiting ones in the order of the plan.

        So trials that were lost or interrupted are trained before those that never began.
        """
        trials = super().get_all_trials(study_id, deepcopy, states)  # type: ignore[safe-super]
        if states != (TrialState.WAITING,):
            return trials
        return sorted(trials, key=lambda trial: trial.system_attrs.get(TICKET, trial.number))
