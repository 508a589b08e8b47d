"""The status of a cell, by its line in an archive or by its folder."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from sb3_sparse.errors import SparsityError
from sb3_sparse.studies.cell import Cell
from sb3_sparse.zoo.archive import Archived, Lines
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import Record, Status


class CellState(str, Enum):
    """The state of a cell. A finished run is done once all of its measures are taken."""

    DONE = "done"
    DIVERGED = "diverged"
    """Its training diverged, and is not retried."""
    RUNNING = "running"
    """A process is training it now."""
    STOPPED = "stopped"
    """It resumes from its last checkpoint."""
    FAILED = "failed"
    WAITING = "waiting"
    """It has not started."""

    __str__ = str.__str__

    @property
    def is_over(self) -> bool:
        """Whether the cell has nothing left to do."""
        return self in (CellState.DONE, CellState.DIVERGED)


@dataclass(frozen=True)
class CellStatus:
    """A cell with its state and progress.

    Example::

        from pathlib import Path
        from sb3_sparse.studies import Study, status_of

        study = Study.read("classic_control", "smoke")
        status = status_of(study.cells[0], Path("studies"))
        print(status.state, status.steps)

    :param cell: the cell
    :param folder: its run's folder, which may not exist
    :param state: its state
    :param steps: environment steps done
    :param reason: what is wrong with its record; None: nothing, or it failed in training
    :param archived: its line in the archive, if that has all of its measures
    """

    cell: Cell
    folder: RunFolder
    state: CellState
    steps: int = 0
    reason: str | None = None
    archived: Archived | None = None

    def why(self, store: Path) -> str:
        """Return why the cell failed, or where that is written.

        :param store: folder of the studies' runs
        """
        return self.reason or f"see {self.cell.errors(store)}"


def status_of(cell: Cell, store: Path, lines: Lines | None = None) -> CellStatus:
    """Return the status of a cell. Its line in the archive takes precedence over its folder.

    :param store: folder of the studies' runs
    :param lines: lines of the archive
    """
    folder = cell.folder(store)
    for line in reversed((lines or {}).get(cell.address, ())):
        state = _over(cell, line.record)
        if state is not None:
            return CellStatus(cell, folder, state, line.record.num_timesteps, archived=line)
    running = folder.is_locked()
    unfinished = CellState.FAILED if cell.errors(store).is_file() else None
    if not folder.has_record:
        state = CellState.RUNNING if running else unfinished or CellState.WAITING
        return CellStatus(cell, folder, state)
    try:
        record = folder.record()
        steps, state = record.num_timesteps, _over(cell, record)
    except SparsityError as error:  # one damaged record must not hide other cells
        told = str(error).replace(f"{store}{os.sep}", "")  # pages show no path of a machine
        return CellStatus(cell, folder, CellState.FAILED, reason=told)
    if running:
        return CellStatus(cell, folder, CellState.RUNNING, steps)
    return CellStatus(cell, folder, state or unfinished or CellState.STOPPED, steps)


def _over(cell: Cell, record: Record) -> CellState | None:
    """Return DONE if a run and its measures are complete, DIVERGED if it diverged, else None."""
    if record.status is Status.DIVERGED:
        return CellState.DIVERGED
    wanted = Status.FINISHED if cell.trained else Status.COUNTED
    done = record.status is wanted and not cell.measures.missing(record)
    return CellState.DONE if done else None


def counts(statuses: Sequence[CellStatus]) -> dict[CellState, int]:
    """Count the cells in each state."""
    found = Counter(one.state for one in statuses)
    return {state: found[state] for state in CellState}


def readable(statuses: Sequence[CellStatus]) -> tuple[list[Path], dict[Path, Archived]]:
    """Return what a report on cells reads: folders that exist, and archived runs by folder."""
    folders = [one.folder.path for one in statuses if one.folder.path.is_dir()]
    return folders, {one.folder.path: one.archived for one in statuses if one.archived is not None}
