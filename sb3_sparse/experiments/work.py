"""Bringing one cell to its end, in a process of its own."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_sparse.experiments.cell import Cell
from sb3_sparse.experiments.measures import FILES
from sb3_sparse.experiments.standing import DONE, OVER, RUNNING, STOPPED, standing_of
from sb3_sparse.zoo.prepare import count
from sb3_sparse.zoo.record import NAME, read_record, write_record
from sb3_sparse.zoo.run import Run


def work_on(cell: Cell, store: Path) -> str:
    """Train a cell, or go on with it, and measure what is wanted; its status afterwards.

    A run that failed while it was trained goes on from its last checkpoint.

    :param store: folder of the studies' runs
    """
    standing = standing_of(cell, store)
    if standing.status in (DONE, RUNNING):
        return standing.status
    folder = standing.folder
    if not cell.trained:
        count(cell.run, folder)
    elif not _trained(folder) and not _train(cell, folder):
        return STOPPED
    record = read_record(folder)
    for name, arguments in cell.measures.missing(record).items():
        _measure_noise(folder, Run(**record["run"]), arguments)
        measured = {**read_record(folder).get("measured", {}), name: dict(arguments)}
        write_record(folder, measured=measured)
    cell.errors(store).unlink(missing_ok=True)
    return DONE


def _trained(folder: Path) -> bool:
    return (folder / NAME).is_file() and read_record(folder)["status"] == OVER[True]


def _train(cell: Cell, folder: Path) -> bool:
    """Train to the end; whether it was reached."""
    from sb3_sparse.zoo.train import resume, train  # rl_zoo3 takes its time to import

    callbacks = cell.measures.callbacks(folder)
    if (folder / NAME).is_file():
        return resume(folder, callbacks).finished
    shutil.rmtree(folder, ignore_errors=True)  # a process that was killed before it wrote anything
    return train(cell.run, callbacks=callbacks, folder=folder).finished


def _measure_noise(folder: Path, run: Run, arguments: Mapping[str, Any]) -> None:
    """Return of the last policy under noise, into ``robustness.csv``, whole or not at all."""
    from sb3_sparse.analysis import noise_robustness
    from sb3_sparse.experiments.noise import noisy_envs
    from sb3_sparse.zoo.environments import is_atari

    model, envs = noisy_envs(folder, run.env_id, run.algo)
    table = noise_robustness(model, envs, **arguments, deterministic=not is_atari(run.env_id))
    path = folder / FILES["noise"]
    new = path.with_suffix(".new")
    with new.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("sigma", "seed", "episode", "return"))
        writer.writerows(table.rows())
    new.replace(path)
