"""A search in a storage: make or join it, fill it with trials, read its status."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, TrialState, optuna, quiet_optuna
from sb3_sparse.tuning.definition import Definition, differences
from sb3_sparse.tuning.lock import locked
from sb3_sparse.tuning.objective import VALUES
from sb3_sparse.tuning.samplers import TICKET
from sb3_sparse.tuning.spaces import with_values

DEFINITION = "sb3_sparse:definition"
FILLED = "sb3_sparse:trials"
ERROR = "error"
DONE = (TrialState.COMPLETE, TrialState.PRUNED)
ALIVE = (TrialState.WAITING, TrialState.RUNNING)


@dataclass(frozen=True)
class SearchStatus:
    """The progress of a search.

    :param all: every trial that was begun, including lost and failed attempts
    :param planned: number of planned trials
    :param done: trials that were completed or pruned, in the order of their numbers
    :param running: trials that are running, or lost but not yet found lost
    :param failed: the last attempts at planned trials, where these failed
    """

    all: tuple[FrozenTrial, ...]
    planned: int
    done: tuple[FrozenTrial, ...]
    running: tuple[FrozenTrial, ...]
    failed: tuple[FrozenTrial, ...]

    @property
    def complete(self) -> tuple[FrozenTrial, ...]:
        """The trials that have a value."""
        return tuple(trial for trial in self.done if trial.state == TrialState.COMPLETE)

    @property
    def best(self) -> FrozenTrial | None:
        """The completed trial with the highest value; the first of several."""
        return max(self.complete, key=lambda trial: trial.values[0], default=None)

    @property
    def finished(self) -> bool:
        """Whether every planned trial is done."""
        return len({ticket_of(trial) for trial in self.done}) >= self.planned

    @staticmethod
    def values_of(trial: FrozenTrial) -> dict[str, Any]:
        """Return a trial's hyperparameters by name."""
        return dict(trial.user_attrs.get(VALUES, trial.params))

    @staticmethod
    def why_failed(trial: FrozenTrial) -> str:
        """Return why a trial failed."""
        return str(trial.user_attrs.get(ERROR, "no reason known"))


class Search:
    """A search for hyperparameters, which a study of Optuna's holds.

    :param study: made by :meth:`enter`
    """

    def __init__(self, study: optuna.Study) -> None:
        self.study = study

    @staticmethod
    def enter(storage: BaseStorage, name: str, definition: Definition, trials: int) -> Search:
        """Make a search, or join the one of that name, and fill it with waiting trials.

        Trials that failed wait again.

        :param trials: least number of trials
        :raises ConfigError: if the name belongs to another search
        """
        wanted = json.loads(json.dumps(definition.as_dict()))
        with locked(storage, name) as alive:
            study = optuna.create_study(
                storage=storage, study_name=name, direction="maximize", load_if_exists=True
            )
            known = study.user_attrs
            if DEFINITION in known or study.get_trials(deepcopy=False):
                _compare(study, wanted)
            else:
                study.set_user_attr("method", definition.method)
                study.set_user_attr(DEFINITION, wanted)
            search = Search(study)
            search._fill(max(trials, known.get(FILLED, 0)), alive)
        return search

    @staticmethod
    def find(storage: BaseStorage, name: str, where: str) -> Search:
        """Load a search that exists.

        :param where: the storage, for the message
        :raises ConfigError: if there is none of that name, or another program made it
        """
        names = [study.study_name for study in storage.get_all_studies()]
        if name not in names:
            raise ConfigError(
                f"there is no search {name!r} in {where}; its searches are "
                f"{', '.join(sorted(names)) or 'none'}"
            )
        study = optuna.load_study(storage=storage, study_name=name)
        if DEFINITION not in study.user_attrs:
            raise ConfigError(
                f"the search {name!r} in {where} was not made by sb3-sparse tune; look at it with "
                "optuna-dashboard"
            )
        return Search(study)

    @property
    def name(self) -> str:
        """Its name in the storage."""
        return self.study.study_name

    @cached_property
    def definition(self) -> Definition:
        """What is tuned, and how."""
        with quiet_optuna():
            return Definition.from_dict(self.study.user_attrs[DEFINITION])

    def status(self) -> SearchStatus:
        """Return its progress."""
        trials = self.study.get_trials(deepcopy=False)
        by_ticket = {ticket_of(trial): trial for trial in trials}  # the last attempt counts
        return SearchStatus(
            all=tuple(trial for trial in trials if trial.state != TrialState.WAITING),
            planned=self.study.user_attrs.get(FILLED, 0),
            done=tuple(trial for trial in trials if trial.state in DONE),
            running=tuple(trial for trial in trials if trial.state == TrialState.RUNNING),
            failed=tuple(t for t in by_ticket.values() if t.state == TrialState.FAIL),
        )

    def best_entry(self) -> tuple[dict[str, Any], str]:
        """Return the settings of the tuned run with the best values, and where these come from.

        :return: the settings, and a line with search, trial, number of trials, score and date
        :raises ConfigError: if no trial was completed
        """
        status, seeds = self.status(), self.definition.seeds
        best = status.best
        if best is None:
            raise ConfigError(f"no trial of {self.name!r} was completed yet; let it continue")
        settings = with_values(self.definition.run, best.user_attrs[VALUES]).settings()
        mean = f", mean of {seeds} seeds" if seeds > 1 else ""
        finished = [t.datetime_complete for t in status.done if t.datetime_complete is not None]
        return settings.as_dict(), (
            f"search {self.name}, trial {best.number} of {len(status.done)} trials, "
            f"score {best.values[0]:.6g}{mean}, {max(finished).date()}"
        )

    def _fill(self, trials: int, alive: Callable[[], None]) -> None:
        known = self.study.get_trials(deepcopy=False)
        present = {ticket_of(trial) for trial in known if trial.state in (*DONE, *ALIVE)}
        for number in range(trials):
            if number % 20 == 0:
                alive()
            if number not in present:
                attributes = {TICKET: number, **self.definition.ticket(number)}
                waiting = optuna.create_trial(state=TrialState.WAITING, system_attrs=attributes)
                self.study.add_trial(waiting)
        if self.study.user_attrs.get(FILLED) != trials:
            self.study.set_user_attr(FILLED, trials)


def folder_name(name: str) -> str:
    """Return the name of a search's folder; different searches have different folders."""
    return re.sub(r"[%/\\]", lambda found: f"%{ord(found.group()):02X}", name)


def ticket_of(trial: FrozenTrial) -> int | None:
    """Return the number of the planned trial that this is an attempt at."""
    number: int | None = trial.system_attrs.get(TICKET)
    return number


def _compare(study: optuna.Study, wanted: dict[str, Any]) -> None:
    known = study.user_attrs.get(DEFINITION)
    differ = ["it was not made by sb3-sparse"] if known is None else differences(wanted, known)
    if differ:
        raise ConfigError(
            f"there is another search {study.study_name!r} in this storage: {'; '.join(differ)}. "
            "Give this one a name of its own with --study-name"
        )
