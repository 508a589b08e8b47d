"""How far a cell is, by its folder alone."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sb3_sparse.errors import SparsityError
from sb3_sparse.experiments.cell import Cell
from sb3_sparse.loading.guard import reading
from sb3_sparse.zoo.checkpoint import is_locked
from sb3_sparse.zoo.record import CURE, DIVERGED, NAME, WHAT, read_record

DONE, RUNNING, STOPPED, FAILED, WAITING = "done", "running", "stopped", "failed", "waiting"
STATUSES = (DONE, DIVERGED, RUNNING, STOPPED, FAILED, WAITING)
OVER = {True: "finished", False: "counted"}


@dataclass(frozen=True)
class CellStanding:
    """A cell and how far it is.

    :param cell: which
    :param folder: its run's folder, there or not
    :param status: ``"done"``, ``"running"`` (some process trains it now), ``"stopped"`` (it goes on
        from its last checkpoint), ``"diverged"`` (it is over), ``"failed"`` or ``"waiting"``
    :param steps: environment steps done
    :param reason: what is wrong with its record; None: nothing, or it failed in training
    """

    cell: Cell
    folder: Path
    status: str
    steps: int = 0
    reason: str | None = None


def standing_of(cell: Cell, store: Path) -> CellStanding:
    """How far a cell is.

    :param store: folder of the studies' runs
    """
    folder = cell.folder(store)
    failed, running = cell.errors(store).is_file(), is_locked(folder)
    if not (folder / NAME).is_file():
        return CellStanding(cell, folder, RUNNING if running else FAILED if failed else WAITING)
    try:
        record = read_record(folder)
        with reading(folder / NAME, WHAT, CURE):
            steps = int(record.get("num_timesteps", 0))
            missing = cell.measures.missing(record)
    except SparsityError as error:  # one damaged record hides no other cell
        told = str(error).replace(f"{store}{os.sep}", "")  # pages name no path of a machine
        return CellStanding(cell, folder, FAILED, reason=told)
    if running:
        return CellStanding(cell, folder, RUNNING, steps)
    if record["status"] == DIVERGED:
        return CellStanding(cell, folder, DIVERGED, steps)
    if record["status"] == OVER[cell.trained] and not missing:
        return CellStanding(cell, folder, DONE, steps)
    return CellStanding(cell, folder, FAILED if failed else STOPPED, steps)


def counts(standings: Sequence[CellStanding]) -> dict[str, int]:
    """How many cells there are of each status."""
    found = Counter(one.status for one in standings)
    return {status: found[status] for status in STATUSES}
