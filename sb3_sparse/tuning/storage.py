"""Where searches are kept: in a journal file or in a database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from optuna.storages import RetryHeartbeatStaleTrialCallback

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, optuna
from sb3_sparse.tuning.database import no_experimental_warnings, open_database, read_database
from sb3_sparse.tuning.journal import open_journal, read_journal
from sb3_sparse.tuning.queue import StaleCallback
from sb3_sparse.tuning.urls import file_of, is_journal

HEARTBEAT = 30
FOLDER = "tune"
JOURNAL = "journal.log"


def open_storage(
    storage: str | Path, heartbeat: int = HEARTBEAT, stale: StaleCallback | None = None
) -> BaseStorage:
    """Open the storage at a path or URL; a new one is made.

    Whoever asks it for a trial gets one that waits in the search, never a new one.

    :param storage: path of a journal file, or a URL of SQLAlchemy's, e.g. ``sqlite:///studies.db``
        or ``postgresql://user:password@host/database``
    :param heartbeat: seconds between two signs of life; a trial without any for three times as
        long is given up, and waits again
    :param stale: called with each such trial
    :raises ConfigError: if it cannot be reached; shows the URL without its password

    Example::

        from sb3_sparse.tuning import open_storage

        storage = open_storage("logs/tune/journal.log")
        print([study.study_name for study in storage.get_all_studies()])
    """
    again = retry_with(stale)
    if not is_journal(storage):
        return open_database(str(storage), heartbeat, again)
    path = Path(storage).absolute()
    with _usable(path):
        return open_journal(path, heartbeat, again)


def open_existing(storage: str | Path) -> BaseStorage:
    """Open a storage for reading; nothing is written into it.

    :raises ConfigError: if there is none, or it cannot be reached
    """
    path = file_of(storage)
    if path is not None and not path.is_file():
        raise ConfigError(
            f"there are no searches in {path}; give the --log-folder or --storage that was tuned "
            "with"
        )
    if not is_journal(storage):
        return read_database(str(storage))
    with _usable(Path(storage)):
        return read_journal(Path(storage))


@contextmanager
def _usable(journal: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"the journal {journal} cannot be used: {error}; restore it from a copy, or name "
            "another file"
        ) from error


def retry_with(stale: StaleCallback | None) -> StaleCallback:
    """Return a callback that makes a trial wait again, and then calls ``stale``."""
    with no_experimental_warnings():
        retry = RetryHeartbeatStaleTrialCallback()

    def again(study: optuna.Study, trial: FrozenTrial) -> None:
        retry(study, trial)
        if stale is not None:
            stale(study, trial)

    return again
