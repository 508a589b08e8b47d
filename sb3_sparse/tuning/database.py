"""Studies in a database that SQLAlchemy has a URL for."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from optuna.storages import RDBStorage
from optuna.storages._cached_storage import _CachedStorage

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.tuning.backend import BaseStorage, TrialState, optuna
from sb3_sparse.tuning.queue import FromQueue, StaleCallback
from sb3_sparse.tuning.urls import shown_url, url_of

OPENINGS = 20
MOMENT = 0.5
T = TypeVar("T")
PATIENCE = 60  # seconds that SQLite waits for other processes


class QueueDatabase(FromQueue, _CachedStorage):
    """A database behind SQLAlchemy, wrapped as Optuna wraps it."""

    def set_trial_state_values(
        self, trial_id: int, state: TrialState, values: Sequence[float] | None = None
    ) -> bool:
        """As in Optuna, but a first sign of life comes before a trial is taken.

        Optuna takes no trial for lost that gave none, e.g. as its worker was killed right then.
        """
        if state == TrialState.RUNNING:
            self.record_heartbeat(trial_id)
        return super().set_trial_state_values(trial_id, state, values)

    def record_heartbeat(self, trial_id: int) -> None:
        """As in Optuna; where the database is away for a moment, the next time will do."""
        with suppress(optuna.exceptions.StorageInternalError):
            super().record_heartbeat(trial_id)


def open_database(storage: str, interval: int, stale: StaleCallback) -> BaseStorage:
    """A database that workers take trials from, with tables made where there are none.

    :param storage: URL
    :param interval: seconds between two signs of life
    :param stale: called with each trial that is found stale
    :raises ConfigError: if it cannot be reached; names the URL without its password
    """
    opened = _connected(storage, interval, stale)
    if url_of(storage).get_backend_name() == "sqlite":
        _take_locks_first(opened.engine)
    return QueueDatabase(opened)


def read_database(storage: str) -> BaseStorage:
    """A database to be looked at; nothing is written.

    :raises ConfigError: if it cannot be reached, or holds no studies
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
            f"there are no studies in {shown_url(storage)}; give the --storage that was tuned with"
        )
    return _connected(storage, None, None)


def _take_locks_first(engine: Any) -> None:
    """Let each transaction take SQLite's lock before it reads.

    To take a trial, to give one up and to number a new one Optuna reads, decides and writes, with
    the row locked meanwhile. SQLite has no locks of rows: two processes would read the same, and
    both write.
    """
    from sqlalchemy import event

    @event.listens_for(engine, "begin")
    def begin(connection: Any) -> None:
        connection.connection.dbapi_connection.isolation_level = None  # no BEGIN of the driver's
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
    """What ``connect`` returns, tried again while other processes make the same tables.

    :raises ConfigError: if the database cannot be reached; names it without its password
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
                time.sleep(MOMENT)
                continue
            text = str(getattr(cause, "orig", error)).strip().splitlines()
            raise ConfigError(
                f"the storage {shown} cannot be reached ({text[0] if text else 'no reason given'}"
                "); check what the URL says, or leave --storage out for a journal file"
            ) from None  # whose text may hold the password
        except RuntimeError as error:  # Optuna: tables of another version
            raise ConfigError(f"the storage {shown} cannot be used: {error}") from error
    raise AssertionError  # the last attempt returns or raises


@contextmanager
def no_experimental_warnings() -> Iterator[None]:
    """Within it, Optuna is silent on what it calls experimental."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        yield
