"""A whole tuning: checks, study, workers, best values."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from platform import node
from typing import Any

from sb3_sparse.errors import ConfigError, TuningFailed
from sb3_sparse.launch import Launcher, Task, check_workers, launcher_named
from sb3_sparse.tuning.backend import FrozenTrial, optuna, quiet_optuna
from sb3_sparse.tuning.best import BEST, write_best
from sb3_sparse.tuning.definition import Definition
from sb3_sparse.tuning.spacefile import space_of
from sb3_sparse.tuning.spaces import Space
from sb3_sparse.tuning.storage import FOLDER, HEARTBEAT, JOURNAL, open_storage
from sb3_sparse.tuning.study import ERROR, Status, enter_study, folder_name, status_of
from sb3_sparse.tuning.urls import is_journal, shown_url
from sb3_sparse.zoo.prepare import prepare
from sb3_sparse.zoo.spec import RunSpec

TRIALS = "trials"
WORK = "sb3_sparse.tuning.worker:work"
Watcher = Callable[[Status], None]


@dataclass(frozen=True)
class Tuned:
    """What came out.

    :param study: Optuna's, to be looked at further
    :param status: how far it is
    :param folder: with the trials' folders, the workers' logs and ``best.yml``
    :param config: YAML file with the best values; None if no trial was completed
    :param began: whether anything was left to do
    :param errors: of workers that ended badly, by name
    """

    study: optuna.Study
    status: Status
    folder: Path
    config: Path | None
    began: bool
    errors: Mapping[str, str]

    @property
    def best(self) -> FrozenTrial | None:
        """The best trial; its ``params`` are the best values, ``values[0]`` the score."""
        return self.status.best


@quiet_optuna()
def tune(
    run: RunSpec,
    space: str | Space = "paper",
    *,
    trials: int | None = None,
    seeds: int = 1,
    sampler: str | None = None,
    pruner: str | None = None,
    name: str | None = None,
    storage: str | Path | None = None,
    log_folder: Path = Path("logs"),
    workers: int = 1,
    launcher: str | Launcher = "local",
    heartbeat: int = HEARTBEAT,
    watch: Watcher | None = None,
) -> Tuned:
    """Search hyperparameters; join the study if it exists, and do nothing if it is finished.

    Every planned trial is trained once, however many workers, on however many machines, take part;
    what a killed worker was at is trained again by another.

    :param run: what is tuned, with the first seed
    :param space: ``"paper"``, ``"wide"``, a file (:func:`space_of`), or a space
    :param trials: how many; None: every cell of a grid, else 100
    :param seeds: runs a trial; its value is their mean score
    :param sampler: ``"grid"``, ``"tpe"`` or ``"random"``; None: a grid where all parameters have
        choices, else TPE
    :param pruner: ``"none"``, ``"median"``, ``"halving"`` or ``"hyperband"``; None: none for a
        grid, else median
    :param name: of the study; None: algorithm, environment, method, sparsity and space
    :param storage: path of a journal file or URL of a database; None: ``tune/journal.log`` in
        ``log_folder``
    :param log_folder: where ``tune/<name>`` is made
    :param workers: how many trials at once
    :param launcher: ``"local"``, ``"ray"`` or one of one's own
    :param heartbeat: seconds between two signs of life of a worker; one that gives none for three
        of them is taken for dead
    :param watch: called with the study's status, about once in a second
    :raises ConfigError: for a value that is not allowed, a storage that cannot be reached, or
        another study of the same name; before anything is trained
    :raises TuningFailed: if every trial failed; with the first one's reason
    """
    check_workers(workers)
    chosen = launcher_named(launcher) if isinstance(launcher, str) else launcher
    definition = define(run, space, seeds, sampler, pruner, log_folder)
    name = definition.default_name if name is None else _checked(name)
    number = definition.trials(trials)
    storage = storage or log_folder / FOLDER / JOURNAL
    folder = log_folder / FOLDER / folder_name(name)
    opened = open_storage(storage, heartbeat)
    errors: dict[str, str] = {}
    with _in_reach(storage):
        study = enter_study(opened, name, definition, number)
        began = not status_of(study).finished
    if began:
        tasks = _tasks(storage, name, folder, workers, heartbeat)
        with closing(chosen.run(tasks, workers)) as endings:
            for ended in endings:
                if ended is not None and ended.error is not None:
                    errors[ended.task.name] = ended.error
                if watch is not None:
                    with suppress(optuna.exceptions.StorageInternalError):  # the workers go on
                        watch(status_of(study))
    with _in_reach(storage):
        status = status_of(study)
        config = write_best(study, folder / BEST) if status.best is not None else None
    _check_outcome(name, status, folder, errors)
    return Tuned(study, status, folder, config, began, errors)


def _check_outcome(name: str, status: Status, folder: Path, errors: Mapping[str, str]) -> None:
    """Raise if nothing came out, and nobody is at work any more."""
    if status.done or status.running or not (status.failed or errors):
        return
    texts = [
        f"trial {trial.number}: {trial.user_attrs.get(ERROR, 'no reason known')}"
        for trial in sorted(status.failed, key=lambda trial: trial.number)
    ] or [f"{worker}: {error.strip().splitlines()[-1]}" for worker, error in errors.items()]
    count = len(status.failed)
    what = f"every trial that was begun ({count})" if count else "every worker"
    raise TuningFailed(
        f"{what} of the study {name!r} failed, first {texts[0]}. The logs of the workers are in "
        f"{folder}; the same command tries again"
    )


@contextmanager
def _in_reach(storage: str | Path) -> Iterator[None]:
    """Say in one line that a storage went away."""
    try:
        yield
    except optuna.exceptions.StorageInternalError:
        raise ConfigError(
            f"the storage {shown_url(storage)} cannot be reached any more; what was done is kept "
            "there, and the same command goes on when it is back"
        ) from None  # whose text may hold the password


def _checked(name: str) -> str:
    if name.strip() in ("", ".", "..") or name.startswith("-"):
        raise ConfigError(
            f"a study cannot be named {name!r}, which is no name of a folder or looks like an "
            "option; give it a name of letters and digits"
        )
    return name


def define(
    run: RunSpec,
    space: str | Space,
    seeds: int,
    sampler: str | None,
    pruner: str | None,
    log_folder: Path,
) -> Definition:
    """The study that :func:`tune` makes, checked; nothing is written."""
    if run.match_params is not None:
        raise ConfigError(
            "--match-params trains one dense network of a given size; tune --method dense, with "
            "net_arch among the --hyperparams, instead"
        )
    prepare(run, log_folder)
    searched = space_of(space, run) if isinstance(space, str) else space
    if sampler is None:
        sampler = "grid" if searched.grid is not None else "tpe"
    if pruner is None:
        pruner = "none" if sampler == "grid" else "median"
    run = replace(run, entry=run.config_entry())  # workers and reports need no file
    return Definition(run, searched, seeds, sampler, pruner)


def _tasks(
    storage: str | Path, name: str, folder: Path, workers: int, heartbeat: int
) -> list[Task]:
    if is_journal(storage):
        storage = str(Path(storage).absolute())
    folder = folder.absolute()
    arguments: dict[str, Any] = {
        "storage": storage,
        "name": name,
        "folder": str(folder / TRIALS),
        "heartbeat": heartbeat,
    }
    return [
        Task(f"worker {n}", WORK, arguments, folder / f"{node()}_{os.getpid()}_{n}.log")
        for n in range(1, workers + 1)
    ]
