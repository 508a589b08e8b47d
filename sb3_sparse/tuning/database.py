"""Databases, by SQLAlchemy's URLs."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from optuna.storages import RDBStorage

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.tuning.backend import BaseStorage, TrialState, optuna
from sb3_sparse.tuning.internals import CachedStorage
from sb3_sparse.tuning.queue import FromQueue, StaleCallback
from sb3_sparse.tuning.urls import shown_url, url_of

OPENINGS = 20
PAUSE = 0.5  # seconds between two openings
T = TypeVar("T")
PATIENCE = 60  # seconds that SQLite waits for other processes


class QueueDatabase(FromQueue, CachedStorage):
    """A database, with the cache that Optuna puts before it."""

    def set_trial_state_values(
        self, trial_id: int, state: TrialState, values: Sequence[float] | None = None
    ) -> bool:
        """Set the state as Optuna does, after a first sign of life if a trial is taken.

        To Optuna a trial without any sign is never lost, even if its worker was killed right then.
        """
        if state == TrialState.RUNNING:
            self.record_heartbeat(trial_id)
        return super().set_trial_state_values(trial_id, state, values)

    def record_heartbeat(self, trial_id: int) -> None:
        """Record a sign of life; if the database is away for a moment, the next one will do."""
        with suppress(optuna.exceptions.StorageInternalError):
            super().record_heartbeat(trial_id)


def open_database(storage: str, interval: int, stale: StaleCallback) -> BaseStorage:
    """Open a database that workers take trials from; missing tables are made.

    :param storage: URL
    :param interval: seconds between two signs of life
    :param stale: called with each stale trial
    :raises ConfigError: if it cannot be reached; shows the URL without its password
    """
    opened = _connected(storage, interval, stale)
    if url_of(storage).get_backend_name() == "sqlite":
        _take_locks_first(opened.engine)
    return QueueDatabase(opened)


def read_database(storage: str) -> BaseStorage:
    """Open a database for reading; nothing is written.

    :raises ConfigError: if it cannot be reached, or holds no searches
    """
    from sqlalchemy import create_engine, inspect

    def has_studies() -> bool:
        engine = create_engine(url_of(storage))
        try:
            return bool(inspect(engine).has_table("studies"))
        finally:
            engine.dispose()

    if not _reached(storage, has_studies):
        raise ConfigError(
            f"there are no searches in {shown_url(storage)}; give the --storage that was tuned with"
        )
    return _connected(storage, None, None)


def _take_locks_first(engine: Any) -> None:
    """Make each transaction take SQLite's lock before it reads.

    To take, give up or number a trial, Optuna reads, decides and writes with the row locked. SQLite
    cannot lock rows: two processes would read the same row, and both would write.
    """
    from sqlalchemy import event

    @event.listens_for(engine, "begin")
    def begin(connection: Any) -> None:
        connection.connection.dbapi_connection.isolation_level = None  # the driver must not begin
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def _connected(storage: str, interval: int | None, stale: StaleCallback | None) -> RDBStorage:
    url = url_of(storage)
    options: dict[str, Any] = {"pool_pre_ping": True}
    if url.get_backend_name() == "sqlite":
        options = {"connect_args": {"timeout": PATIENCE}}

    def connect() -> RDBStorage:
        with no_experimental_warnings():
            return RDBStorage(
                url.render_as_string(hide_password=False),
                heartbeat_interval=interval,
                grace_period=None if interval is None else 3 * interval,
                heartbeat_stale_trial_callback=stale,
                engine_kwargs=options,
            )

    return _reached(storage, connect)


def _reached(storage: str, connect: Callable[[], T]) -> T:
    """Return what ``connect`` returns; try again while other processes make the same tables.

    :raises ConfigError: if the database cannot be reached; shows its URL without the password
    """
    from sqlalchemy.exc import IntegrityError, OperationalError, ProgrammingError, SQLAlchemyError

    shown = shown_url(storage)
    for attempt in range(1, OPENINGS + 1):
        try:
            return connect()
        except ImportError as error:
            if url_of(storage).get_backend_name() == "postgresql":
                raise MissingExtra(f"the storage {shown}", "postgres") from error
            raise ConfigError(f"the storage {shown} needs a driver: {error}") from error
        except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
            cause = error if isinstance(error, SQLAlchemyError) else error.__cause__
            busy = "already exists" in str(cause) or "locked" in str(cause)
            made = isinstance(cause, (IntegrityError, ProgrammingError))
            if attempt < OPENINGS and (made or (isinstance(cause, OperationalError) and busy)):
                time.sleep(PAUSE)
                continue
            text = str(getattr(cause, "orig", error)).strip().splitlines()
            raise ConfigError(
                f"the storage {shown} cannot be reached ({text[0] if text else 'no reason given'}"
                "); check the URL, or leave --storage out for a journal file"
            ) from None  # its text may hold the password
        except RuntimeError as error:  # tables of another version of Optuna
            raise ConfigError(f"the storage {shown} cannot be used: {error}") from error
    raise AssertionError  # the last attempt returns or raises


@contextmanager
def no_experimental_warnings() -> Iterator[None]:
    """Ignore warnings that a feature of Optuna is experimental, within the block."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield
