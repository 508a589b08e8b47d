"""Studies in a storage: made, joined, filled with trials that wait, looked at."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, TrialState, optuna, quiet_optuna
from sb3_sparse.tuning.definition import Definition, differences
from sb3_sparse.tuning.samplers import TICKET

DEFINITION = "sb3_sparse:definition"
FILLED = "sb3_sparse:trials"
SIGN = "alive"
ERROR = "error"
PATIENCE = 60.0
DONE = (TrialState.COMPLETE, TrialState.PRUNED)
ALIVE = (TrialState.WAITING, TrialState.RUNNING)


def enter_study(
    storage: BaseStorage, name: str, definition: Definition, trials: int
) -> optuna.Study:
    """Make a study, or join the one of that name, and see that all its trials are there.

    Trials that failed wait once more.

    :param trials: how many the study shall have at least
    :raises ConfigError: if there is another study of that name
    """
    wanted = json.loads(json.dumps(definition.as_dict()))
    with _alone(storage, name) as alive:
        study = optuna.create_study(
            storage=storage, study_name=name, direction="maximize", load_if_exists=True
        )
        known = study.user_attrs
        if DEFINITION in known or study.get_trials(deepcopy=False):
            _compare(study, wanted)
        else:
            study.set_user_attr("method", definition.method)
            study.set_user_attr(DEFINITION, wanted)
        _fill(study, definition_of(study), max(trials, known.get(FILLED, 0)), alive)
    return study


def folder_name(name: str) -> str:
    """The name of a study's folder; no two studies have the same."""
    return re.sub(r"[%/\\]", lambda found: f"%{ord(found.group()):02X}", name)


@contextmanager
def _alone(storage: BaseStorage, name: str) -> Iterator[Callable[[], None]]:
    """Within it, no other process makes or fills the study, on whatever machine.

    What all storages do for one process alone is to make a study of a new name. Yields what gives
    a sign of life; whoever gives none for long is taken for dead.
    """
    lock, seen, since = f"{name} is being filled", None, time.monotonic()
    while True:
        try:
            held = optuna.create_study(storage=storage, study_name=lock)
            held_id = storage.get_study_id_from_name(lock)
            break
        except optuna.exceptions.DuplicatedStudyError:
            sign = _sign_of(storage, lock)
            if sign != seen:
                seen, since = sign, time.monotonic()
            elif sign is not None and time.monotonic() - since > PATIENCE:
                _delete(storage, sign[0])
            time.sleep(0.2)
    try:
        yield lambda: held.set_user_attr(SIGN, time.time())
    finally:
        _delete(storage, held_id)  # and no other's, should this one have been taken for dead


def _sign_of(storage: BaseStorage, lock: str) -> tuple[int, Any] | None:
    try:
        study_id = storage.get_study_id_from_name(lock)
        return study_id, storage.get_study_user_attrs(study_id).get(SIGN)
    except KeyError:  # it has just been given back
        return None


def _delete(storage: BaseStorage, study_id: int) -> None:
    with suppress(KeyError):  # another process was quicker
        storage.delete_study(study_id)


def _compare(study: optuna.Study, wanted: dict[str, Any]) -> None:
    known = study.user_attrs.get(DEFINITION)
    differ = ["it was not made by sb3-sparse"] if known is None else differences(wanted, known)
    if differ:
        raise ConfigError(
            f"there is another study {study.study_name!r} in this storage: {'; '.join(differ)}. "
            "Give this one a name of its own with --study-name"
        )


def _fill(
    study: optuna.Study, definition: Definition, trials: int, alive: Callable[[], None]
) -> None:
    known = study.get_trials(deepcopy=False)
    present = {ticket_of(trial) for trial in known if trial.state in (*DONE, *ALIVE)}
    for number in range(trials):
        if number % 20 == 0:
            alive()
        if number not in present:
            attributes = {TICKET: number, **definition.ticket(number)}
            study.add_trial(optuna.create_trial(state=TrialState.WAITING, system_attrs=attributes))
    if study.user_attrs.get(FILLED) != trials:
        study.set_user_attr(FILLED, trials)


def find_study(storage: BaseStorage, name: str, where: str) -> optuna.Study:
    """A study that exists.

    :param where: the storage, for the message
    :raises ConfigError: if there is none of that name, or it is none of this package's
    """
    names = [study.study_name for study in storage.get_all_studies()]
    if name not in names:
        raise ConfigError(
            f"there is no study {name!r} in {where}; its studies are "
            f"{', '.join(sorted(names)) or 'none'}"
        )
    study = optuna.load_study(storage=storage, study_name=name)
    if DEFINITION not in study.user_attrs:
        raise ConfigError(
            f"the study {name!r} in {where} was not made by sb3-sparse tune; look at it with "
            "optuna-dashboard"
        )
    return study


@quiet_optuna()
def definition_of(study: optuna.Study) -> Definition:
    """What the study is."""
    return Definition.from_dict(study.user_attrs[DEFINITION])


def ticket_of(trial: FrozenTrial) -> int | None:
    """Which of the study's planned trials this is an attempt at."""
    number: int | None = trial.system_attrs.get(TICKET)
    return number


@dataclass(frozen=True)
class Status:
    """How far a study is.

    :param all: every trial that was begun, lost and failed attempts too
    :param planned: trials that it shall have
    :param done: trials that were completed or pruned, in the order of their numbers
    :param running: trials at work, or lost without anyone having noticed yet
    :param failed: last attempts at planned trials, where these failed
    """

    all: tuple[FrozenTrial, ...]
    planned: int
    done: tuple[FrozenTrial, ...]
    running: tuple[FrozenTrial, ...]
    failed: tuple[FrozenTrial, ...]

    @property
    def complete(self) -> tuple[FrozenTrial, ...]:
        """Trials with a value."""
        return tuple(trial for trial in self.done if trial.state == TrialState.COMPLETE)

    @property
    def best(self) -> FrozenTrial | None:
        """The completed trial of the highest value; the first of several."""
        return max(self.complete, key=lambda trial: trial.values[0], default=None)

    @property
    def finished(self) -> bool:
        """Whether every planned trial is done."""
        return len({ticket_of(trial) for trial in self.done}) >= self.planned


def status_of(study: optuna.Study) -> Status:
    """How far the study is now."""
    trials = study.get_trials(deepcopy=False)
    by_ticket: dict[int | None, FrozenTrial] = {}
    for trial in trials:
        by_ticket[ticket_of(trial)] = trial  # the last attempt counts
    return Status(
        all=tuple(trial for trial in trials if trial.state != TrialState.WAITING),
        planned=study.user_attrs.get(FILLED, 0),
        done=tuple(trial for trial in trials if trial.state in DONE),
        running=tuple(trial for trial in trials if trial.state == TrialState.RUNNING),
        failed=tuple(t for t in by_ticket.values() if t.state == TrialState.FAIL),
    )
