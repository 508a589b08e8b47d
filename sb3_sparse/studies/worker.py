"""Runs one cell to its end, in a separate process.

The top imports what training needs, once for all cells (:mod:`sb3_sparse.launch.local`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, Diverged, RunBusy
from sb3_sparse.files import write_csv
from sb3_sparse.studies.cell import Cell
from sb3_sparse.studies.measures import FILES
from sb3_sparse.studies.noise import noisy_envs
from sb3_sparse.studies.status import CellState, status_of
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.prepare import count
from sb3_sparse.zoo.record import Status
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.training import resume, train
from sb3_sparse.zoo.watch import TrainingLog


def work_on(cell: Cell, store: Path) -> CellState:
    """Train or resume a cell, take its measures, and return its state.

    A run that failed during training resumes from its last checkpoint.

    :param store: folder of the studies' runs
    """
    found = status_of(cell, store)
    if found.state.is_over or found.state is CellState.RUNNING:
        return found.state
    folder = found.folder
    try:
        if not cell.trained:
            count(cell.run, folder)
        elif not _is_trained(folder) and not _train(cell, folder):
            return CellState.STOPPED
        with folder.locked():
            _measure(cell, folder)
    except RunBusy:  # another process has started it since
        return CellState.RUNNING
    except Diverged:  # recorded; a retry would only hide a bad setting
        cell.errors(store).unlink(missing_ok=True)
        return CellState.DIVERGED
    cell.errors(store).unlink(missing_ok=True)
    return CellState.DONE


def _is_trained(folder: RunFolder) -> bool:
    return folder.has_record and folder.record().status is Status.FINISHED


def _train(cell: Cell, folder: RunFolder) -> bool:
    """Train, and return whether the run reached its end."""
    callbacks = cell.measures.callbacks(folder.path)
    watch = TrainingLog()
    try:
        if folder.has_record:
            return resume(folder.path, callbacks, watch).finished
        folder.clear_leftovers()
        return train(cell.run, callbacks=callbacks, folder=folder.path, watch=watch).finished
    except RunBusy:
        raise
    except ConfigError:
        if _is_trained(folder):  # another process finished it meanwhile
            return True
        raise


def _measure(cell: Cell, folder: RunFolder) -> None:
    """Take the measures that the trained model still lacks."""
    for name, arguments in cell.measures.missing(folder.record()).items():
        _measure_noise(folder.path, arguments)
        folder.write(measured={**folder.record().measured, name: dict(arguments)})


def _measure_noise(folder: Path, arguments: Mapping[str, Any]) -> None:
    """Write returns of the last policy under noise to ``robustness.csv``, whole or not at all."""
    from sb3_sparse.analysis import noise_robustness

    saved = SavedModel.find(folder)
    model = saved.load()
    deterministic = saved.acts_deterministically
    table = noise_robustness(
        model, noisy_envs(saved, model), **arguments, deterministic=deterministic
    )
    write_csv(folder / FILES["noise"], ("sigma", "seed", "episode", "return"), table.rows())
