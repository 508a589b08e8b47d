"""What the runs of a study cost, estimated from runs that have been timed."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from sb3_sparse.errors import SparsityError
from sb3_sparse.pages.numbers import counted, short
from sb3_sparse.studies.cell import DIGITS, RUNS, Cell
from sb3_sparse.studies.status import CellState, CellStatus
from sb3_sparse.zoo.archive import Lines
from sb3_sparse.zoo.clock import computed_in
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import Record, Status

HOUR = 3600.0
UNLIKE = frozenset({"seed", "n_timesteps", "eval_freq", "eval_episodes", "device"})
"""What may differ between runs that are otherwise alike: a step of theirs costs the same."""
SOURCES = (
    "by runs that differ in seed and length alone",
    "by runs of their method and sparsity with other settings",
    "by other methods in their environment",
    "by other environments",
)
"""What a cost is estimated from; the first that has a timed run counts."""


@dataclass(frozen=True)
class Cost:
    """The cost of some runs.

    :param runs: their number
    :param seconds: what those cost whose cost is known
    :param sources: how many of them are estimated from what, by the place in ``SOURCES``
    :param unknown: algorithms of which no run has been timed
    """

    runs: int = 0
    seconds: float = 0.0
    sources: Mapping[int, int] = field(default_factory=dict)
    unknown: frozenset[str] = frozenset()

    def __add__(self, other: Cost) -> Cost:
        return Cost(
            self.runs + other.runs,
            self.seconds + other.seconds,
            Counter(self.sources) + Counter(other.sources),
            self.unknown | other.unknown,
        )

    def __str__(self) -> str:
        number = short(self.seconds / HOUR)
        hours = f"{number} core {'hour' if number == '1' else 'hours'}"
        if self.unknown:
            hours = f"more than {hours}" if self.seconds else "core hours unknown"
        return f"{counted(self.runs, 'run')}, {hours}"

    def remarks(self) -> list[str]:
        """Return how many are estimated from unlike runs, and what is unknown."""
        unlike = [
            f"{count} {SOURCES[place]}" for place, count in sorted(self.sources.items()) if place
        ]
        timed = f"no run of {' and '.join(sorted(self.unknown))} has been timed yet"
        return [*unlike, timed] if self.unknown else unlike


class Costs:
    """Costs of a step of training, by the runs that have been timed.

    :param records: records of runs of any study; those that are not finished, or of versions that
        did not count seconds, tell nothing
    """

    def __init__(self, records: Iterable[Record]) -> None:
        self._found: dict[str, list[float]] = defaultdict(list)
        for record in records:
            with suppress(SparsityError):  # one damaged record must not hide the others
                self._add(record)

    @classmethod
    def known(cls, store: Path, lines: Lines | None = None) -> Costs:
        """Read all runs of an archive, and those of the store that are not in it.

        :param store: folder of the studies' runs
        :param lines: lines of the archive
        """
        known = lines or {}
        return cls(
            [
                *(line.record for same in known.values() for line in same[-1:]),
                *_records(store, known.keys()),
            ]
        )

    def _add(self, record: Record) -> None:
        with record.reading():
            seconds = computed_in(record)
            if record.status is Status.FINISHED and seconds is not None and record.num_timesteps:
                asked = record.settings.policy_kwargs.get("sparsity")
                for key in _keys(record["run"], record["method"], asked):
                    self._found[key].append(seconds / record.num_timesteps)

    def of(self, cell: Cell, done: int = 0) -> Cost:
        """Estimate the cost of a cell by the median of runs as like it as there are.

        It is that of training alone, without evaluations and measures of the trained model. A cell
        that is only counted costs nothing.

        :param done: environment steps of it that are done
        """
        if not cell.trained:
            return Cost(1)
        run, settings = cell.run, cell.settings
        steps = max(0, int(settings["n_timesteps"]) - done)
        asked = settings.policy_kwargs.get("sparsity")
        for place, key in enumerate(_keys(run.as_dict(), run.name_of(settings), asked)):
            if key in self._found:
                return Cost(1, steps * median(self._found[key]), {place: 1})
        return Cost(1, unknown=frozenset({run.algo.upper()}))

    def left(self, statuses: Iterable[CellStatus]) -> Cost:
        """Estimate what is left of cells that are not over."""
        found = (self.of(one.cell, one.steps) for one in statuses if not one.state.is_over)
        return sum(found, Cost())

    def to_seeds(self, same: Sequence[CellStatus], seeds: int) -> Cost:
        """Estimate the cost of as many done seeds of a cell.

        :param same: cells that differ in the seed alone; seeds that are not among them count, too
        """
        missing = max(0, seeds - sum(one.state is CellState.DONE for one in same))
        planned = [one for one in same if not one.state.is_over][:missing]
        further = [self.of(same[0].cell)] * (missing - len(planned))
        return sum(further, self.left(planned))


def but_for_seeds(statuses: Iterable[CellStatus]) -> list[list[CellStatus]]:
    """Group cells that differ in the seed alone."""
    found: dict[str, list[CellStatus]] = defaultdict(list)
    for one in statuses:
        found[one.cell.with_seed(0).address].append(one)
    return list(found.values())


def _keys(run: Mapping[str, Any], method: str, sparsity: Any) -> list[str]:
    """Return what a run is looked up by, in the order of ``SOURCES``.

    :param run: the content of its specification
    """
    alike = {name: value for name, value in run.items() if _given(value) and name not in UNLIKE}
    algo, env_id = run["algo"], run["env_id"]
    matched = run.get("match_params")
    keys = [alike, [algo, env_id, method, sparsity, matched], [algo, env_id], [algo]]
    return [json.dumps(key, sort_keys=True, default=str) for key in keys]


def _given(value: Any) -> bool:
    return value is not None and value not in ({}, [], ())


def _records(store: Path, without: Iterable[str]) -> Iterator[Record]:
    """Read the records of a store's runs.

    :param without: addresses to leave out
    """
    left_out = frozenset(without)
    for path in sorted((store / RUNS).glob("*/*")):
        folder = RunFolder(path)
        if folder.has_record and path.name[-DIGITS:] not in left_out:
            with suppress(SparsityError):
                yield folder.record()
