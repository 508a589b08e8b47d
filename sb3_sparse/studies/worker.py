"""Bringing one cell to its end, in a process of its own.

What training needs is imported at the top: once for all cells (:mod:`sb3_sparse.launch.local`).
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, Diverged, RunBusy
from sb3_sparse.files import write_csv
from sb3_sparse.studies.cell import Cell
from sb3_sparse.studies.measures import FILES
from sb3_sparse.studies.status import DONE, OVER, RUNNING, STOPPED, status_of
from sb3_sparse.zoo.checkpoint import LOCK, locked
from sb3_sparse.zoo.prepare import count
from sb3_sparse.zoo.record import DIVERGED, NAME, read_record, write_record
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import resume, train
from sb3_sparse.zoo.watch import TrainingLog


def work_on(cell: Cell, store: Path) -> str:
    """Train a cell, or go on with it, and measure what is wanted; its status afterwards.

    A run that failed while it was trained goes on from its last checkpoint.

    :param store: folder of the studies' runs
    """
    found = status_of(cell, store)
    if found.status in (DONE, DIVERGED, RUNNING):
        return found.status
    folder = found.folder
    try:
        if not cell.trained:
            count(cell.run, folder)
        elif not _trained(folder) and not _train(cell, folder):
            return STOPPED
        with locked(folder):
            _measure(cell, folder)
    except RunBusy:  # another process has begun it since
        return RUNNING
    except Diverged:  # which is on record, and would only hide a bad setting if tried again
        cell.errors(store).unlink(missing_ok=True)
        return DIVERGED
    cell.errors(store).unlink(missing_ok=True)
    return DONE


def _measure(cell: Cell, folder: Path) -> None:
    """Measure what is still wanted of the trained model."""
    record = read_record(folder)
    for name, arguments in cell.measures.missing(record).items():
        _measure_noise(folder, RunSpec(**record["run"]), arguments)
        measured = {**read_record(folder).get("measured", {}), name: dict(arguments)}
        write_record(folder, measured=measured)


def _trained(folder: Path) -> bool:
    return (folder / NAME).is_file() and read_record(folder)["status"] == OVER[True]


def _train(cell: Cell, folder: Path) -> bool:
    """Train to the end; whether it was reached."""
    callbacks = cell.measures.callbacks(folder)
    watch = TrainingLog()
    try:
        if (folder / NAME).is_file():
            return resume(folder, callbacks, watch).finished
        _clear(folder)
        return train(cell.run, callbacks=callbacks, folder=folder, watch=watch).finished
    except RunBusy:
        raise
    except ConfigError:
        if _trained(folder):  # by another process, since this one looked
            return True
        raise


def _clear(folder: Path) -> None:
    """Remove what a run without a record has left, unless some process is at it."""
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        if (folder / NAME).is_file():  # it has begun since
            return
        for path in folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LOCK:
                path.unlink()


def _measure_noise(folder: Path, run: RunSpec, arguments: Mapping[str, Any]) -> None:
    """Return of the last policy under noise, into ``robustness.csv``, whole or not at all."""
    from sb3_sparse.analysis import noise_robustness
    from sb3_sparse.studies.noise import noisy_envs
    from sb3_sparse.zoo.environments import is_atari

    model, envs = noisy_envs(folder)
    table = noise_robustness(model, envs, **arguments, deterministic=not is_atari(run.env_id))
    write_csv(folder / FILES["noise"], ("sigma", "seed", "episode", "return"), table.rows())
