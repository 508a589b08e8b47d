"""The lock on a run's folder, which one process at a time holds."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from sb3_sparse.errors import RunBusy
from sb3_sparse.zoo.disk import writing

PATIENCE = 1.0  # seconds; other processes hold the lock briefly to test it


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock, and remove its file at the end.

    :param path: the lock's file, in the folder that it locks
    :raises RunBusy: if another process holds it
    :raises Unwritable: if the folder is not writable
    """
    folder, lock = path.parent, FileLock(path)
    try:
        with writing(folder, "free space or make it writable, then repeat the command"):
            lock.acquire(timeout=PATIENCE)
    except Timeout as error:
        raise RunBusy(f"another process is at work in {folder}") from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows keeps an open file
            path.unlink()
        lock.release()


def is_locked(path: Path) -> bool:
    """Whether a process holds a lock; the check writes nothing."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        return not _can_lock(descriptor)
    finally:
        os.close(descriptor)


def _can_lock(descriptor: int) -> bool:
    if sys.platform == "win32":
        import msvcrt

        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            msvcrt.locking(descriptor, msvcrt.LK_UNLCK, 1)
        except OSError:
            return False
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # released when the file closes
    except BlockingIOError:
        return False
    return True
