"""A lock that works in every storage: a study with a name of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from sb3_sparse.tuning.backend import BaseStorage, optuna

SIGN = "alive"
PATIENCE = 60.0  # seconds without a sign of life, after which the holder counts as dead
PAUSE = 0.2


@contextmanager
def locked(storage: BaseStorage, name: str) -> Iterator[Callable[[], None]]:
    """Keep all other processes, on any machine, from filling a search within the block.

    Making a study of a new name is the one step that every storage lets only one process take. The
    lock is such a study, and is deleted at the end.

    :param name: name of the search
    :return: a function that gives a sign of life, to be called more often than once a minute
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
            time.sleep(PAUSE)
    try:
        yield lambda: held.set_user_attr(SIGN, time.time())
    finally:
        _delete(storage, held_id)  # by its id: another process may have taken the lock over


def _sign_of(storage: BaseStorage, lock: str) -> tuple[int, Any] | None:
    try:
        study_id = storage.get_study_id_from_name(lock)
        return study_id, storage.get_study_user_attrs(study_id).get(SIGN)
    except KeyError:  # it was released just now
        return None


def _delete(storage: BaseStorage, study_id: int) -> None:
    with suppress(KeyError):  # another process was quicker
        storage.delete_study(study_id)
