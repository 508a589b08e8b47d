"""Small runs to tune, and what to search in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

from sb3_sparse.launch import Launcher, TaskResult
from sb3_sparse.tuning import Space
from sb3_sparse.tuning.backend import TrialState, optuna
from sb3_sparse.tuning.objective import planned_evaluations
from sb3_sparse.tuning.search import Search
from sb3_sparse.tuning.tuner import define
from sb3_sparse.zoo.results import score_of
from sb3_sparse.zoo.spec import RunSpec


class NoWorkers(Launcher):
    """Runs nothing, so that a study is made and left."""

    def run(self, tasks, workers):
        yield from ()


class Here(Launcher):
    """Runs the tasks in this process."""

    def run(self, tasks, workers):
        for task in tasks:
            try:
                yield TaskResult(task, value=task())
            except Exception as error:
                yield TaskResult(task, error=f"Traceback:\n{error}")


def small_run(**changes) -> RunSpec:
    """A run of a second."""
    settings = dict(
        n_timesteps=600,
        eval_freq=100,
        eval_episodes=2,
        hyperparams={"net_arch": [16], "learning_starts": 50, "buffer_size": 1000},
    )
    return RunSpec(**{**settings, **changes})


def choices(**lists) -> Space:
    """A grid."""
    of = optuna.distributions.CategoricalDistribution
    return Space("small", {name: of(values) for name, values in lists.items()})


def searched(
    storage: Any,
    name: str,
    returns: Callable[[dict[str, Any], int], list[float]],
    run: RunSpec,
    space: Space,
    seeds: int = 1,
    trials: int | None = None,
    sampler: str | None = None,
) -> optuna.Study:
    """A search whose trials were not trained.

    :param returns: mean returns of the evaluations of a seed, by the trial's values and the seed;
        a trial is pruned after a seed with fewer than planned
    """
    definition = define(run, space, seeds, sampler, "none", Path("logs"))
    wanted, planned = definition.trials(trials), planned_evaluations(run)
    study = Search.enter(storage, name, definition, wanted).study
    study.sampler = definition.make_sampler()

    def objective(trial: optuna.Trial) -> float:
        values = definition.space.sample(trial)
        trial.set_user_attr("hyperparams", values)
        scores: list[float] = []
        for seed in range(seeds):
            found = returns(values, seed)
            for place, value in enumerate(found, 1):
                trial.report(fmean([*scores, value]), seed * planned + place)
            if len(found) < planned:
                raise optuna.TrialPruned
            scores.append(score_of(found))
            trial.set_user_attr("scores", list(scores))
        return fmean(scores)

    waiting = study.get_trials(states=(TrialState.WAITING,))
    if waiting:
        study.optimize(objective, n_trials=len(waiting))
    return study
