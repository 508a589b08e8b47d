"""A whole search: checks, workers, best values."""

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
from sb3_sparse.tuning.search import Search, SearchStatus, folder_name
from sb3_sparse.tuning.spacefile import space_of
from sb3_sparse.tuning.spaces import Space
from sb3_sparse.tuning.storage import FOLDER, HEARTBEAT, JOURNAL, open_storage
from sb3_sparse.tuning.urls import is_journal, shown_url
from sb3_sparse.zoo.prepare import prepare
from sb3_sparse.zoo.spec import RunSpec

TRIALS = "trials"
WORK = "sb3_sparse.tuning.worker:work"
Watcher = Callable[[SearchStatus], None]


@dataclass(frozen=True)
class Tuned:
    """The outcome of a search.

    :param study: Optuna's study of the search, with all trials
    :param status: its progress
    :param folder: where the trials' folders, the workers' logs and ``best.yml`` are
    :param config: YAML file with the best values; None if no trial was completed
    :param began: whether anything was left to do
    :param errors: the errors of workers that ended badly, by the worker's name

    Example::

        from sb3_sparse.tuning import tune
        from sb3_sparse.zoo import RunSpec

        run = RunSpec("dqn", "CartPole-v1", method="static", n_timesteps=200, eval_freq=100)
        tuned = tune(run, trials=1)
        print(tuned.best.params, tuned.best.value, tuned.config)
    """

    study: optuna.Study
    status: SearchStatus
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
    """Search hyperparameters.

    An existing search of the same name is joined; if it is finished, nothing is trained. Every
    planned trial is trained once, with any number of workers on any number of machines; the trial
    of a killed worker is trained again by another.

    :param run: what is tuned, with the first seed
    :param space: ``"paper"``, ``"wide"``, a file (:func:`space_of`), or a space
    :param trials: how many trials; None: every cell of a grid, else 100
    :param seeds: runs per trial; the trial's value is their mean score
    :param sampler: ``"grid"``, ``"tpe"`` or ``"random"``; None: grid if all parameters have
        choices, else TPE
    :param pruner: ``"none"``, ``"median"``, ``"halving"`` or ``"hyperband"``; None: none for a
        grid, else median
    :param name: name of the search; None: algorithm, environment, method, sparsity and space
    :param storage: path of a journal file or URL of a database; None: ``tune/journal.log`` in
        ``log_folder``
    :param log_folder: where ``tune/<name>`` is made
    :param workers: how many trials run at once
    :param launcher: ``"local"``, ``"ray"`` or a launcher of your own
    :param heartbeat: seconds between two signs of life of a worker; without any for three times as
        long, it counts as dead
    :param watch: called with the search's status about once a second
    :return: the outcome
    :raises ConfigError: for a value that is not allowed, a storage that cannot be reached, or a
        name that belongs to another search; before anything is trained
    :raises TuningFailed: if every trial failed; with the reason of the first
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
        search = Search.enter(opened, name, definition, number)
        began = not search.status().finished
    if began:
        tasks = _tasks(storage, name, folder, workers, heartbeat)
        with closing(chosen.run(tasks, workers)) as endings:
            for ended in endings:
                if ended is not None and ended.error is not None:
                    errors[ended.task.name] = ended.error
                if watch is not None:
                    with suppress(optuna.exceptions.StorageInternalError):  # the workers continue
                        watch(search.status())
    with _in_reach(storage):
        status = search.status()
        config = write_best(search, folder / BEST) if status.best is not None else None
    _check_outcome(name, status, folder, errors)
    return Tuned(search.study, status, folder, config, began, errors)


def _check_outcome(
    name: str, status: SearchStatus, folder: Path, errors: Mapping[str, str]
) -> None:
    """Raise if no trial is done or running."""
    if status.done or status.running or not (status.failed or errors):
        return
    texts = [
        f"trial {trial.number}: {status.why_failed(trial)}"
        for trial in sorted(status.failed, key=lambda trial: trial.number)
    ] or [f"{worker}: {error.strip().splitlines()[-1]}" for worker, error in errors.items()]
    count = len(status.failed)
    what = f"every trial that was begun ({count})" if count else "every worker"
    raise TuningFailed(
        f"{what} of the search {name!r} failed, first {texts[0]}. The logs of the workers are in "
        f"{folder}; the same command tries again"
    )


@contextmanager
def _in_reach(storage: str | Path) -> Iterator[None]:
    """Raise an error of one line if the storage goes away within the block."""
    try:
        yield
    except optuna.exceptions.StorageInternalError:
        raise ConfigError(
            f"the storage {shown_url(storage)} cannot be reached any more; finished trials are "
            "kept there, and the same command continues when it is back"
        ) from None  # its text may hold the password


def _checked(name: str) -> str:
    if name.strip() in ("", ".", "..") or name.startswith("-"):
        raise ConfigError(
            f"a search cannot be named {name!r}, which is not a folder's name or looks like an "
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
    """Return the checked definition of a search; nothing is written."""
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
