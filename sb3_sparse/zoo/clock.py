"""Counts the seconds that a run trains."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.zoo.arguments import is_finite
from sb3_sparse.zoo.record import Record


@dataclass(frozen=True)
class Seconds:
    """Seconds of training.

    :param wall: seconds that passed
    :param processor: seconds that the process computed, over all its threads; those of other
        processes do not count, so a busy machine changes them little
    """

    wall: float = 0.0
    processor: float = 0.0

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall + other.wall, self.processor + other.processor)

    def __sub__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall - other.wall, self.processor - other.processor)


class Clock:
    """Counts the seconds of training, without evaluations and checkpoints, which pause it.

    :param before: seconds that the run trained in earlier processes; None: not known, as in
        records of older versions, so that its total is not known either
    """

    def __init__(self, before: Seconds | None) -> None:
        self._spent = before
        self._since: Seconds | None = None

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count the seconds of the body."""
        self._since = now()
        try:
            yield
        finally:
            self._stop()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Do not count the seconds of the body."""
        self._stop()
        try:
            yield
        finally:
            self._since = now()

    def entry(self) -> dict[str, Any]:
        """Return the record's entry, to be read while the clock does not run."""
        return {} if self._spent is None else {"seconds": asdict(self._spent)}

    def _stop(self) -> None:
        if self._spent is not None and self._since is not None:
            self._spent += now() - self._since
        self._since = None


def now() -> Seconds:
    """Return the present time; only differences mean anything."""
    return Seconds(time.perf_counter(), time.process_time())


def seconds_in(record: Record) -> Seconds | None:
    """Read from a record how long its run has trained; None in records of older versions.

    :raises CorruptStateError: if the record is damaged
    """
    if "seconds" not in record:
        return None
    with record.reading():
        entry = record["seconds"]
        found = Seconds(entry["wall"], entry["processor"])
        if not all(is_finite(one) and one >= 0 for one in (found.wall, found.processor)):
            raise CorruptStateError(f"{record.source} is damaged: its seconds are {entry!r}")
        return found


def computed_in(record: Record) -> float | None:
    """Read from a record how many seconds its run computed; None in records of older versions.

    Those of the processor, which other processes do not change, or on a GPU those that passed.
    Evaluations and checkpoints are not among them.

    :raises CorruptStateError: if the record is damaged
    """
    found = seconds_in(record)
    if found is None:
        return None
    return found.processor if record.get("device", "cpu") == "cpu" else found.wall
