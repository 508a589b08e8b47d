"""Where studies are kept: a journal file, or whatever database Optuna has a URL for."""

from __future__ import annotations

import os
import tempfile
import time
import warnings
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from optuna.storages import JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages._cached_storage import _CachedStorage
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, TrialState, optuna
from sb3_sparse.tuning.samplers import TICKET
from sb3_sparse.tuning.urls import file_of, is_journal, shown_url, url_of

HEARTBEAT = 30
FOLDER = "tune"
JOURNAL = "journal.log"
OPENINGS = 20
MOMENT = 0.5
StaleCallback = Callable[["optuna.Study", FrozenTrial], None]


class QueueEmpty(Exception):
    """There is no trial left to take."""


class _FromQueue(BaseStorage):
    """Gives out the trials that wait in a study, and never makes one for a worker that asks.

    A study holds its whole budget as waiting trials. Taking one is atomic in every storage, so no
    trial is trained twice, whatever the sampler and however many workers there are.
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


class QueueDatabase(_FromQueue, _CachedStorage):
    """A database behind SQLAlchemy, wrapped as Optuna wraps it."""


class QueueJournal(_FromQueue, JournalStorage, BaseHeartbeat):
    """A journal file, with what Optuna has for databases alone: signs of life.

    A worker touches a file of its trial in ``<journal>.alive/``; a trial whose file has not been
    touched for ``3 * interval`` is stale.

    :param path: of the journal
    :param interval: seconds between two signs of life
    :param stale: called with each trial that is found stale
    """

    def __init__(self, path: Path, interval: int, stale: StaleCallback) -> None:
        self._alive = path.with_name(f"{path.name}.alive")
        self._alive.mkdir(parents=True, exist_ok=True)
        lock = JournalFileOpenLock(str(path)) if os.name == "nt" else None
        super().__init__(JournalFileBackend(str(path), lock))
        self._interval, self._stale = interval, stale

    def record_heartbeat(self, trial_id: int) -> None:
        """Touch the trial's file."""
        (self._alive / str(trial_id)).touch()

    def set_trial_state_values(
        self, trial_id: int, state: TrialState, values: Sequence[float] | None = None
    ) -> bool:
        """As in Optuna; a trial that is over needs no file."""
        changed = super().set_trial_state_values(trial_id, state, values)
        if state.is_finished():
            (self._alive / str(trial_id)).unlink(missing_ok=True)
        return changed

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        with tempfile.TemporaryFile(dir=self._alive) as new:
            now = os.fstat(new.fileno()).st_mtime  # by the clock of the files, whoever asks
        running = self.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
        return [
            trial._trial_id
            for trial in running
            if now - self._last_sign(trial) > 3 * self._interval
        ]

    def _last_sign(self, trial: FrozenTrial) -> float:
        try:
            return (self._alive / str(trial._trial_id)).stat().st_mtime
        except FileNotFoundError:  # taken this moment, or killed before its first sign
            assert trial.datetime_start is not None
            return trial.datetime_start.timestamp()

    def get_heartbeat_interval(self) -> int | None:
        """Seconds between two signs of life."""
        return self._interval

    def get_heartbeat_stale_trial_callback(self) -> StaleCallback | None:
        """What is called with each stale trial."""
        return self._stale

    get_failed_trial_callback = get_heartbeat_stale_trial_callback


def open_storage(
    storage: str | Path, heartbeat: int = HEARTBEAT, stale: StaleCallback | None = None
) -> BaseStorage:
    """The storage at a path or URL, made if it is new; workers take waiting trials only.

    :param storage: path of a journal file, or a URL of SQLAlchemy's, e.g. ``sqlite:///studies.db``
        or ``postgresql://user:password@host/database``
    :param heartbeat: seconds between two signs of life; after three without, a trial is given up
    :param stale: called with such a trial, beside putting it into the queue again
    :raises ConfigError: if it cannot be reached; names the URL without its password
    """
    again = retry_with(stale)
    if is_journal(storage):
        path = Path(storage).absolute()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            return QueueJournal(path, heartbeat, again)
        except (OSError, ValueError) as error:
            raise ConfigError(f"the journal {path} cannot be used: {error}") from error
    return QueueDatabase(_database(str(storage), heartbeat, again))


def _database(storage: str, heartbeat: int, again: StaleCallback) -> RDBStorage:
    from sqlalchemy.exc import IntegrityError, OperationalError, ProgrammingError, SQLAlchemyError

    url, shown = url_of(storage), shown_url(storage)
    alone = url.get_backend_name() == "sqlite"
    for attempt in range(1, OPENINGS + 1):
        try:
            with _no_experimental_warnings():
                return RDBStorage(
                    url.render_as_string(hide_password=False),
                    heartbeat_interval=heartbeat,
                    grace_period=3 * heartbeat,
                    heartbeat_stale_trial_callback=again,
                    engine_kwargs={} if alone else {"pool_pre_ping": True},
                )
        except ImportError as error:
            if url.get_backend_name() == "postgresql":
                raise MissingExtra(f"the storage {shown}", "postgres") from error
            raise ConfigError(f"the storage {shown} needs a driver: {error}") from error
        except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
            cause = error if isinstance(error, SQLAlchemyError) else error.__cause__
            busy = "already exists" in str(cause) or "locked" in str(cause)
            made = isinstance(cause, (IntegrityError, ProgrammingError))
            if attempt < OPENINGS and (made or (isinstance(cause, OperationalError) and busy)):
                time.sleep(MOMENT)  # another process is making the same tables
                continue
            text = str(getattr(cause, "orig", error)).strip().splitlines()
            raise ConfigError(
                f"the storage {shown} cannot be reached ({text[0] if text else 'no reason given'}"
                "); check what the URL says, or leave --storage out for a journal file"
            ) from None  # whose text may hold the password
    raise AssertionError  # the last attempt returns or raises


def open_existing(storage: str | Path) -> BaseStorage:
    """A storage to be looked at.

    :raises ConfigError: if there is none, or it cannot be reached
    """
    path = file_of(storage)
    if path is not None and not path.is_file():
        raise ConfigError(
            f"there are no studies in {path}; give the --log-folder or --storage that was tuned "
            "with"
        )
    return open_storage(storage)


def retry_with(stale: StaleCallback | None) -> StaleCallback:
    """A callback that puts a trial into the queue again, and calls ``stale``."""
    with _no_experimental_warnings():
        retry = RetryHeartbeatStaleTrialCallback()

    def again(study: optuna.Study, trial: FrozenTrial) -> None:
        retry(study, trial)
        if stale is not None:
            stale(study, trial)

    return again


@contextmanager
def _no_experimental_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield
