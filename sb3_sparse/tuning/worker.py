"""A worker: it takes trials from a search until none is left."""

from __future__ import annotations

import shutil
import time
import traceback
from pathlib import Path
from platform import node

from sb3_sparse.tuning.backend import FrozenTrial, Trial, TrialState, optuna, quiet_optuna
from sb3_sparse.tuning.objective import Objective
from sb3_sparse.tuning.queue import QueueEmpty
from sb3_sparse.tuning.search import ERROR, Search
from sb3_sparse.tuning.storage import HEARTBEAT, open_storage, retry_with
from sb3_sparse.tuning.urls import shown_url

FAILURES = 3
PAUSE = 1.0  # seconds between two looks for a trial


class TooManyFailures(Exception):
    """Several trials in a row have failed."""


@quiet_optuna()
def work(
    storage: str | Path, name: str, folder: str | Path, heartbeat: int = HEARTBEAT
) -> dict[str, int]:
    """Take and train trials until all of a search are done, including those that others lose.

    :param storage: path or URL
    :param name: name of the search
    :param folder: where the trials' folders go
    :param heartbeat: seconds between two signs of life
    :return: how many trials were ``"trained"`` and how many ``"failed"``
    :raises ConfigError: if this machine does not see the search
    :raises TooManyFailures: after three failures in a row, with the text of the last
    :raises KeyboardInterrupt: when stopped; the current trial waits again
    """
    trials = Path(folder)

    def forget(study: optuna.Study, trial: FrozenTrial) -> None:
        shutil.rmtree(trials / str(trial.number), ignore_errors=True)

    opened = open_storage(storage, heartbeat, forget)
    search = Search.find(opened, name, f"{shown_url(storage)} of {node()}")
    study, definition = search.study, search.definition
    study.sampler, study.pruner = definition.make_sampler(), definition.make_pruner()
    objective = Objective(definition.run, definition.space, definition.seeds, trials)
    again = retry_with(forget)
    counts, in_a_row = {"trained": 0, "failed": 0}, 0
    while True:
        attempt = _Attempt(objective)
        try:
            study.optimize(attempt, n_trials=1)
            counts["trained"], in_a_row = counts["trained"] + 1, 0
        except QueueEmpty:
            if not search.status().running:
                return counts
            time.sleep(PAUSE)  # until the others end, or are found lost
        except KeyboardInterrupt:
            if attempt.number is not None:
                trial = study.get_trials(deepcopy=False)[attempt.number]
                if trial.state == TrialState.FAIL:
                    again(study, trial)
            raise
        except Exception as error:
            if attempt.number is None:
                raise  # the storage, not a trial
            counts["failed"], in_a_row = counts["failed"] + 1, in_a_row + 1
            if in_a_row == FAILURES:
                raise TooManyFailures(
                    f"{FAILURES} trials in a row have failed, the last one with: {error}"
                ) from error


class _Attempt:
    """The objective of one trial, which records the trial's number and its error.

    :param objective: objective of the search
    """

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        self.number: int | None = None

    def __call__(self, trial: Trial) -> float:
        self.number = trial.number
        try:
            return self.objective(trial)
        except optuna.TrialPruned:
            raise
        except Exception as error:
            trial.set_user_attr(ERROR, f"{type(error).__name__}: {error}")
            traceback.print_exc()
            raise
