"""Reads runs from folders and archives; unreadable ones are named with a reason, never averaged."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_sparse.errors import ConfigError, CorruptStateError, SparsityError
from sb3_sparse.loading.arrays import read_arrays
from sb3_sparse.report.data import Array, LeftOut, RunData
from sb3_sparse.report.measured import MEASURED, measured_text, rows_of
from sb3_sparse.report.methods import DENSE
from sb3_sparse.zoo.archive import Archived
from sb3_sparse.zoo.folder import EVALUATIONS, RunFolder
from sb3_sparse.zoo.record import NAME, Record, Status

NEAR = 0.01
"""Share of the connections that a run may miss; rounding and schedules miss far less."""


class _DivergedRun(ConfigError):
    """A run whose training ended in NaN."""


def read_runs(
    folders: Iterable[Path | str], archived: Mapping[Path, Archived] | None = None
) -> tuple[list[RunData], list[LeftOut]]:
    """Read run folders, and runs of an archive.

    :param folders: folders of single runs, e.g. ``logs/dqn/CartPole-v1_1``
    :param archived: archived runs by the folder that they have or had; they take precedence over
        the folder's content
    :return: finished and counted runs in a fixed order, and what was left out. Of two runs with the
        same settings and seed, the first in the order of folders stays
    """
    runs: list[RunData] = []
    out: list[LeftOut] = []
    first: dict[str, Path] = {}
    lines = archived or {}
    for folder in sorted({*map(Path, folders), *lines}):
        try:
            run, remarks = _read(folder, lines.get(folder))
        except SparsityError as error:
            told = str(error).replace(f"{folder}{os.sep}", "")
            out.append(LeftOut(folder, told, isinstance(error, _DivergedRun)))
            continue
        same = first.setdefault(_identity(run), folder)
        if same != folder:
            out.append(LeftOut(folder, f"duplicate: the same settings and seed as {same}"))
            continue
        runs.append(run)
        out += [LeftOut(folder, remark) for remark in remarks]
    return runs, out


def _read(folder: Path, archived: Archived | None) -> tuple[RunData, list[str]]:
    if archived is None and not folder.is_dir():
        raise ConfigError("missing: there is no such folder")
    record = RunFolder(folder).record() if archived is None else archived.record
    empty = np.zeros(0)
    diverged = ""
    with record.reading():
        _check_complete(record)
        if record.status is Status.DIVERGED:
            diverged = _divergence(RunData(folder, record, empty, empty))
        else:
            _check_reached(record)
    if diverged:
        raise _DivergedRun(diverged)
    timesteps, returns = empty, empty
    if record.status is Status.FINISHED:
        timesteps, returns = (
            _evaluations(folder / EVALUATIONS)
            if archived is None
            else (archived.timesteps, archived.returns.mean(axis=1))
        )
    measured, remarks = {}, []
    for name, columns in MEASURED.items():
        try:
            text = _measured_text(folder / name, archived)
            if text is not None:
                measured[name] = rows_of(text, folder / name, columns)
        except SparsityError as error:
            remarks.append(f"only its {name}: {error}; the rest of the run is in")
    run = RunData(folder, record, timesteps, returns, measured)
    with record.reading():
        _try_out(run)
    return run, remarks


def _measured_text(path: Path, archived: Archived | None) -> str | None:
    """Return the text of a file of measurements; None if the run has none."""
    if archived is not None:
        return archived.measured.get(path.name)
    return measured_text(path) if path.is_file() else None


def _divergence(run: RunData) -> str:
    """Describe what diverged and when, in one line."""
    level = "" if run.label == DENSE else f" {run.level:.0%}"
    which = f"{run.algo.upper()} on {run.env_id}, {run.label}{level}, seed {run.seed}"
    return f"{which}: {run.record.get('error') or 'training diverged, no step is recorded'}"


def _try_out(run: RunData) -> None:
    """Read everything that a report reads, so that a wrong type shows here."""
    numbers = [run.seed, run.steps, run.level, run.parameters, run.connections, run.flops]
    numbers += [run.dense_flops, run.actor_share or 0.0, run.score if run.trained else 0.0]
    numbers += [run.seconds or 0.0]
    if not all(map(math.isfinite, numbers)):
        raise CorruptStateError(f"{run.folder / NAME} is damaged: a number in it is not finite")
    for layer in run.layers:
        if not all(type(size) is int and size > 0 for size in layer["shape"]):
            raise CorruptStateError(
                f"{run.folder / NAME} is damaged: {layer['name']} has shape {layer['shape']!r}"
            )
    _identity(run)
    run.variant()
    for name in ("algo", "env_id", "family", "label", "changes"):
        getattr(run, name)


def _evaluations(path: Path) -> tuple[Array, Array]:
    if not path.is_file():
        raise ConfigError(f"{path.name} is missing")
    cure = "restore it from a copy, or train again"
    content = read_arrays(path, "file of evaluations", cure, ("timesteps", "results"))
    timesteps = content["timesteps"].astype(np.float64)
    results = content["results"].astype(np.float64)
    if results.ndim != 2 or results.size == 0 or timesteps.shape != results.shape[:1]:
        raise ConfigError(
            f"{path.name} is damaged: results of shape {results.shape} for "
            f"{len(timesteps)} evaluations"
        )
    returns = results.mean(axis=1)
    if not all(map(math.isfinite, returns)):
        raise ConfigError(f"{path.name} holds returns that are not finite")
    return timesteps, returns


def _identity(run: RunData) -> str:
    keys = ("algo", "env_id", "seed", "match_params")
    asked = {name: run.record["run"].get(name) for name in keys}
    content = [asked, run.record["method"], run.trained, dict(run.settings)]
    return json.dumps(content, sort_keys=True, default=str)


def _check_complete(record: Record) -> None:
    """Check that a run has ended and that its record lacks nothing.

    :raises ConfigError: with the status or the missing part
    """
    if record.status is Status.FAILED:
        raise ConfigError(f"failed: {record.get('error') or 'no reason is recorded'}")
    if not record.status.is_over:
        raise ConfigError(f"not finished: its status is {str(record.status)!r}")
    for name in ("run", "settings", "total", "layers", "method"):
        if not record.get(name):
            raise ConfigError(f"{NAME} is incomplete: {name!r} is missing")
    needed = {"run": ("algo", "env_id", "seed"), "total": ("sparsity", "parameters", "flops")}
    for part, names in needed.items():
        for name in names:
            if not isinstance(record[part], dict) or record[part].get(name) is None:
                raise ConfigError(f"{NAME} is incomplete: {part}.{name} is missing")


def _check_reached(record: Record) -> None:
    """Check that a run's networks are as sparse as its settings say.

    Older records lack ``wanted_nnz``; only runs with a denser start can have stayed too dense.

    :raises ConfigError: with the sparsity that it reached and the one that it should have reached
    """
    total, kwargs = record["total"], record.settings.policy_kwargs
    reached = float(total["sparsity"])
    asked: Any = kwargs.get("sparsity")
    wanted = total.get("wanted_nnz")
    if wanted is not None:
        missed = abs(int(total["nnz"]) - int(wanted)) > NEAR * int(wanted)
    else:
        denser = kwargs.get("initial_sparsity") is not None and isinstance(asked, (int, float))
        missed = denser and reached < asked - NEAR
    if missed:
        raise ConfigError(
            f"its sparsity is {reached:.2%}, not the {asked} that its settings ask for: it was not "
            "pruned, or not to the end; train it again with a callback that prunes, longer or with "
            "a smaller update_interval"
        )
