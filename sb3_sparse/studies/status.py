"""How far a cell is, by its line in an archive or by its folder."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_sparse.errors import SparsityError
from sb3_sparse.loading.guard import reading
from sb3_sparse.studies.cell import Cell
from sb3_sparse.zoo.archive import Archived, Lines
from sb3_sparse.zoo.checkpoint import is_locked
from sb3_sparse.zoo.record import CURE, DIVERGED, NAME, WHAT, read_record

DONE, RUNNING, STOPPED, FAILED, WAITING = "done", "running", "stopped", "failed", "waiting"
STATUSES = (DONE, DIVERGED, RUNNING, STOPPED, FAILED, WAITING)
OVER = {True: "finished", False: "counted"}


@dataclass(frozen=True)
class CellStatus:
    """A cell and how far it is.

    :param cell: which
    :param folder: its run's folder, there or not
    :param status: ``"done"``, ``"running"`` (some process trains it now), ``"stopped"`` (it goes on
        from its last checkpoint), ``"diverged"`` (it is over), ``"failed"`` or ``"waiting"``
    :param steps: environment steps done
    :param reason: what is wrong with its record; None: nothing, or it failed in training
    :param archived: its line in the archive, if that has all that is wanted of it
    """

    cell: Cell
    folder: Path
    status: str
    steps: int = 0
    reason: str | None = None
    archived: Archived | None = None


def status_of(cell: Cell, store: Path, lines: Lines | None = None) -> CellStatus:
    """How far a cell is. A line in the archive goes before what lies in its folder.

    :param store: folder of the studies' runs
    :param lines: of the archive
    """
    folder = cell.folder(store)
    for line in reversed((lines or {}).get(cell.address, ())):
        status, steps = _over(cell, line.record), int(line.record.get("num_timesteps", 0))
        if status is not None:
            return CellStatus(cell, folder, status, steps, archived=line)
    failed, running = cell.errors(store).is_file(), is_locked(folder)
    if not (folder / NAME).is_file():
        return CellStatus(cell, folder, RUNNING if running else FAILED if failed else WAITING)
    try:
        record = read_record(folder)
        with reading(folder / NAME, WHAT, CURE):
            steps = int(record.get("num_timesteps", 0))
            status = _over(cell, record)
    except SparsityError as error:  # one damaged record hides no other cell
        told = str(error).replace(f"{store}{os.sep}", "")  # pages name no path of a machine
        return CellStatus(cell, folder, FAILED, reason=told)
    if running:
        return CellStatus(cell, folder, RUNNING, steps)
    return CellStatus(cell, folder, status or (FAILED if failed else STOPPED), steps)


def _over(cell: Cell, record: Mapping[str, Any]) -> str | None:
    """Whether a run is done with all that is wanted of it, or diverged; None: neither."""
    if record["status"] == DIVERGED:
        return DIVERGED
    done = record["status"] == OVER[cell.trained] and not cell.measures.missing(record)
    return DONE if done else None


def counts(statuses: Sequence[CellStatus]) -> dict[str, int]:
    """How many cells there are of each status."""
    found = Counter(one.status for one in statuses)
    return {status: found[status] for status in STATUSES}
