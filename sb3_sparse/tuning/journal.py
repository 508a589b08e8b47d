"""Journal files, which survive torn writes and dead workers."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from optuna.storages import JournalStorage
from optuna.storages.journal import (
    JournalFileBackend,
    JournalFileOpenLock,
    JournalFileSymlinkLock,
)

from sb3_sparse.errors import warn
from sb3_sparse.tuning.backend import BaseStorage, FrozenTrial, TrialState
from sb3_sparse.tuning.internals import SignsOfLife, id_of
from sb3_sparse.tuning.queue import FromQueue, StaleCallback

RECORD = b'{"op_code":'  # how Optuna begins each line


class JournalFile(JournalFileBackend):
    """A journal in which an unfinished line harms no other.

    A full disk or a power cut can leave half a line. Optuna would write the next record behind it,
    and could not read the journal any more. Here the half line moves into ``<journal>.torn``.

    :param path: path of the journal; a new one is made
    :raises ValueError: if the file is not a journal, or is damaged before its last line; the file
        then stays as it is
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        kind = JournalFileOpenLock if os.name == "nt" else JournalFileSymlinkLock
        self.lock = kind(str(path))
        super().__init__(str(path), self.lock)
        with self._locked():
            self._set_aside(_damaged_from(path))

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Append all records, or none."""
        lines = "".join(f"{json.dumps(log, separators=(',', ':'))}\n" for log in logs)
        with self._locked():
            self._set_aside(_torn_from(self.path))
            with self.path.open("ab", buffering=0) as file:
                end = file.tell()
                try:
                    written = file.write(lines.encode())
                    if written != len(lines.encode()):
                        raise OSError(f"the disk took {written} bytes of {len(lines)}")
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(end)
                    raise

    @contextmanager
    def _locked(self) -> Iterator[None]:
        self.lock.acquire()
        try:
            yield
        finally:
            self.lock.release()

    def _set_aside(self, position: int | None) -> None:
        """Move everything behind a position into a file beside the journal, with a warning."""
        if position is None:
            return
        aside = self.path.with_name(f"{self.path.name}.torn")
        with self.path.open("r+b") as file:
            file.seek(position)
            tail = file.read()
            with aside.open("ab") as kept:
                kept.write(tail + b"\n")
                kept.flush()
                os.fsync(kept.fileno())
            file.truncate(position)
            os.fsync(file.fileno())
        warn(
            f"the last line of the journal {self.path} was not written to its end, as after a "
            f"power cut or on a full disk; its {len(tail)} bytes are in {aside} now, and the "
            "search continues without them"
        )


def _torn_from(path: Path) -> int | None:
    """Return where a last line without an end begins; None if the last line has one."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        if size == 0:
            return None
        file.seek(size - 1)
        if file.read(1) == b"\n":
            return None
        file.seek(0)
        return file.read().rfind(b"\n") + 1


def _damaged_from(path: Path) -> int | None:
    """Return where a damaged last line begins; None if all lines are records.

    :raises ValueError: if another line is damaged, or if the file does not look like a journal
    """
    position = 0
    with path.open("rb") as file:
        line, number = file.readline(), 1
        while line:
            following = file.readline()
            if not _is_record(line, parse=not following):
                if following or (number == 1 and not RECORD.startswith(line[: len(RECORD)])):
                    raise ValueError(f"its line {number} is not a record of Optuna")
                return position
            position += len(line)
            line, number = following, number + 1
    return None


def _is_record(line: bytes, parse: bool) -> bool:
    if not (line.startswith(RECORD) and line.endswith(b"}\n")):
        return False
    try:
        return not parse or isinstance(json.loads(line), dict)
    except ValueError:  # text or encoding
        return False


class QueueJournal(FromQueue, JournalStorage, SignsOfLife):
    """A journal file with signs of life, which Optuna has for databases only.

    A worker touches the file of its trial in ``<journal>.alive/``. A trial whose file has not been
    touched for ``3 * interval`` is stale.

    :param path: path of the journal
    :param interval: seconds between two signs of life
    :param stale: called with each stale trial
    """

    def __init__(self, path: Path, interval: int, stale: StaleCallback) -> None:
        super().__init__(JournalFile(path))
        self._alive = path.with_name(f"{path.name}.alive")
        self._alive.mkdir(exist_ok=True)
        self._interval, self._stale = interval, stale

    def record_heartbeat(self, trial_id: int) -> None:
        """Touch the trial's file; if that fails, the next sign will do."""
        with suppress(OSError):
            (self._alive / str(trial_id)).touch()

    def set_trial_state_values(
        self, trial_id: int, state: TrialState, values: Sequence[float] | None = None
    ) -> bool:
        """Set the state as Optuna does, and remove the file of a trial that has ended."""
        changed = super().set_trial_state_values(trial_id, state, values)
        if state.is_finished():
            (self._alive / str(trial_id)).unlink(missing_ok=True)
        return changed

    def stale_trials(self, study_id: int) -> list[FrozenTrial]:
        with tempfile.TemporaryFile(dir=self._alive) as new:
            now = os.fstat(new.fileno()).st_mtime  # the file system's clock, on any machine
        running = self.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
        return [trial for trial in running if now - self._last_sign(trial) > 3 * self._interval]

    def _last_sign(self, trial: FrozenTrial) -> float:
        try:
            return (self._alive / str(id_of(trial))).stat().st_mtime
        except FileNotFoundError:  # just taken, or its worker was killed before its first sign
            assert trial.datetime_start is not None
            return trial.datetime_start.timestamp()

    def get_heartbeat_interval(self) -> int | None:
        """Return the seconds between two signs of life."""
        return self._interval

    def get_heartbeat_stale_trial_callback(self) -> StaleCallback | None:
        """Return the function that is called with each stale trial."""
        return self._stale


def open_journal(path: Path, interval: int, stale: StaleCallback) -> BaseStorage:
    """Open a journal that workers take trials from; a new one is made.

    :param path: path of the file
    :param interval: seconds between two signs of life
    :param stale: called with each stale trial
    :raises ValueError: if it is damaged before its last line, or is not a journal
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    return QueueJournal(path, interval, stale)


def read_journal(path: Path) -> BaseStorage:
    """Open a journal for reading; nothing is written, and half a last line is skipped.

    :raises ValueError: if it is damaged before its last line, or is not a journal
    """
    _damaged_from(path)
    return JournalStorage(JournalFileBackend(str(path)))
