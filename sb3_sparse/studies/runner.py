"""Runs a study: every cell that is not done, several at a time."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from sb3_sparse.errors import SparsityError, warn
from sb3_sparse.launch.base import Launcher, Task, TaskResult
from sb3_sparse.studies.cell import Cell
from sb3_sparse.studies.measures import FILES
from sb3_sparse.studies.spec import Study
from sb3_sparse.studies.status import CellState, status_of
from sb3_sparse.zoo.archive import Archive, Archived

FUNCTION = "sb3_sparse.studies.worker:work_on"


@dataclass
class Progress:
    """The progress of a study, which :func:`run_study` yields.

    Example::

        from pathlib import Path
        from sb3_sparse.launch import launcher_named
        from sb3_sparse.studies import Study, run_study

        study = Study.read("flops", "smoke")
        steps = run_study(study, Path("studies"), launcher_named("local"), workers=1)
        progress = next(steps)
        steps.close()  # the next call continues
        print(progress.done, "of", progress.planned)

    :param planned: number of cells
    :param done: cells that are done, including before this start
    :param elsewhere: cells that another process is training
    :param running: cells that are being trained here
    :param diverged: cells whose training diverged, including before this start
    :param failed: tracebacks of cells that failed twice, by name
    :param retried: names of cells that failed once
    :param ended: name of the cell that has just ended, if one has
    """

    planned: int
    done: int = 0
    elsewhere: int = 0
    running: int = 0
    diverged: int = 0
    failed: dict[str, str] = field(default_factory=dict)
    retried: list[str] = field(default_factory=list)
    ended: str | None = None
    finished_here: int = 0
    started: float = field(default_factory=time.monotonic)

    @property
    def open(self) -> int:
        """Number of cells that are still to be done here."""
        return self.planned - self.done - self.diverged - self.elsewhere - len(self.failed)

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds left at the speed so far; None before the first cell has ended."""
        if self.finished_here == 0:
            return None
        return (time.monotonic() - self.started) / self.finished_here * self.open


def run_study(
    study: Study, store: Path, launcher: Launcher, workers: int, archive: Path | None = None
) -> Generator[Progress, None, None]:
    """Run every cell of a study to its end, and yield the progress about once a second.

    Cells start in the study's order, first seeds first. Cells that are done or diverged are not
    run again, interrupted ones resume, and failed ones are tried once more after all others.
    Closing the iterator stops running cells at their next rollout; the next call resumes them.

    :param study: the study to run
    :param store: folder of runs, which studies share
    :param launcher: runs the processes
    :param workers: number of cells to run at a time, 1 or more
    :param archive: file of an :class:`~sb3_sparse.zoo.archive.Archive`; cells in it count as done,
        and each cell that ends is appended to it
    :raises CorruptStateError: if a line of the archive is damaged
    """
    kept = _Kept(store, archive)
    statuses = [status_of(cell, store, kept.lines) for cell in study.cells]
    over = [one for one in statuses if one.state.is_over]
    kept.add(one.cell for one in over if one.archived is None)
    diverged = sum(one.state is CellState.DIVERGED for one in over)
    progress = Progress(len(study.cells), done=len(over) - diverged, diverged=diverged)
    cells = [one.cell for one in statuses if not one.state.is_over]
    yield progress
    again: set[str] = set()
    for attempt in (1, 2):
        now = cells if attempt == 1 else [cell for cell in cells if cell.address in again]
        tasks = [_task(cell, store) for cell in now]
        left = len(tasks)
        if not tasks:
            return
        for ended in launcher.run(tasks, workers):
            progress.ended = None
            if ended is not None:
                left -= 1
                cell = ended.task.arguments["cell"]
                if ended.error is not None and attempt == 1:
                    again.add(cell.address)
                    progress.retried.append(cell.name)
                _account(progress, cell, store, ended, last=attempt == 2)
                if ended.error is None and ended.value.is_over:
                    kept.add([cell])
            progress.running = min(workers, left)
            yield progress


class _Kept:
    """The archive of a study's cells, if there is one.

    :param store: folder of the runs
    :param path: the archive's file; None: no archive
    """

    def __init__(self, store: Path, path: Path | None) -> None:
        self.store = store
        self.archive = None if path is None else Archive(path)
        self.lines = {} if path is None or not path.exists() else Archive(path).read()

    def add(self, cells: Iterable[Cell]) -> None:
        """Append cells that have ended, and warn about those that cannot be read."""
        if self.archive is None:
            return
        found = []
        for cell in cells:
            folder = cell.folder(self.store)
            try:
                found.append(Archived.of_folder(folder, cell.address, FILES.values()))
            except SparsityError as error:
                warn(f"{cell.name} does not go into the archive: {error}")
        self.archive.add(found)


def _task(cell: Cell, store: Path) -> Task:
    log = store / "log" / f"{cell.address}.txt"
    return Task(cell.name, FUNCTION, {"cell": cell, "store": store.absolute()}, log)


def _account(progress: Progress, cell: Cell, store: Path, ended: TaskResult, last: bool) -> None:
    if ended.error is not None:
        path = cell.errors(store)
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(f"{cell.name}\n{ended.error.rstrip()}\n\n")
        if last:
            progress.failed[cell.name] = ended.error
        return
    state = CellState(ended.value)
    diverged = state is CellState.DIVERGED
    progress.ended = f"{cell.name}, diverged" if diverged else cell.name
    if state.is_over:
        progress.done += not diverged
        progress.diverged += diverged
        progress.finished_here += 1
    elif state is CellState.RUNNING:
        progress.elsewhere += 1
