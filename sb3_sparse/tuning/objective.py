"""The objective of a search: train with sampled values, once for each seed."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.errors import ConfigError, Diverged
from sb3_sparse.tuning.backend import Trial, optuna
from sb3_sparse.tuning.spaces import Space, with_values
from sb3_sparse.zoo.evaluation import Evaluation
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import Status
from sb3_sparse.zoo.results import score_of
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

MAX_SEEDS = 1000
VALUES = "hyperparams"


class Objective:
    """An objective for ``optuna.Study.optimize``, to be maximized.

    A trial samples the space and trains the run with ``seed``, ``seed + 1``, ... one after the
    other; all trials have the same seeds. Its value is the mean of their scores, where a score is
    the mean return of the last 10 % of evaluations. After each evaluation the trial reports the
    mean over the seeds so far, at steps 1, 2, ... of all its evaluations, and asks the study's
    pruner.

    Each seed leaves a run's folder in ``folder/<trial number>/<algo>``, and the trial has the user
    attributes ``hyperparams`` (the sampled values), ``scores`` (one per seed), ``worker`` and
    ``seconds``.

    :param run: what is tuned
    :param space: what is sampled; see :func:`sb3_sparse.tuning.space_of`
    :param seeds: runs per trial
    :param folder: where the trials' folders go
    :raises ConfigError: for less than one seed, or runs without any evaluation

    Example::

        import optuna

        from sb3_sparse.tuning import Objective, Space
        from sb3_sparse.zoo import RunSpec

        run = RunSpec("dqn", "CartPole-v1", method="rigl", n_timesteps=200, eval_freq=100)
        decays = optuna.distributions.CategoricalDistribution([0.0, 1e-4])
        study = optuna.create_study(direction="maximize")
        study.optimize(Objective(run, Space("mine", {"weight_decay": decays})), n_trials=1)
        print(study.best_params, study.best_value)
    """

    def __init__(
        self, run: RunSpec, space: Space, seeds: int = 1, folder: Path = Path("logs/tune/trials")
    ) -> None:
        check_seeds(seeds)
        self.run, self.space, self.seeds, self.folder = run, space, seeds, folder
        self.planned = planned_evaluations(run)

    def __call__(self, trial: Trial) -> float:
        """Train, and return the mean score of the seeds.

        :raises optuna.TrialPruned: if the study's pruner stops the trial, or if training diverges
        :raises KeyboardInterrupt: after SIGINT or SIGTERM, at the end of the current rollout
        """
        began = time.monotonic()
        values = self.space.sample(trial)
        trial.set_user_attr(VALUES, values)
        run = with_values(self.run, values)
        trial.set_user_attr("worker", f"{platform.node()}:{os.getpid()}")
        scores: list[float] = []
        for seed in range(self.seeds):
            evaluations = _Report(trial, scores, self.planned, self.seeds)
            folder = self.folder / str(trial.number)
            try:
                outcome = train(
                    replace(run, seed=run.seed + seed), folder, after_evaluation=evaluations
                )
            except optuna.TrialPruned:
                pruned = RunFolder(evaluations.parent.folder)
                pruned.clear_checkpoints()
                pruned.write(status=Status.PRUNED, error=None)
                raise
            except Diverged as error:  # a result: these values train nothing
                trial.set_user_attr("diverged", str(error))
                raise optuna.TrialPruned(str(error)) from error
            if not outcome.finished:
                raise KeyboardInterrupt
            scores.append(score_of(evaluations.returns))
            trial.set_user_attr("scores", list(scores))
        trial.set_user_attr("seconds", round(time.monotonic() - began, 1))
        return fmean(scores)


def check_seeds(seeds: int) -> None:
    """Check the number of runs per trial.

    :raises ConfigError: if it is out of range
    """
    if not 1 <= seeds <= MAX_SEEDS:
        raise ConfigError(f"seeds must lie in [1, {MAX_SEEDS}], got {seeds}")


def planned_evaluations(run: RunSpec) -> int:
    """Return how many evaluations a run has.

    :raises ConfigError: if it has none
    """
    steps, every = run.settings()["n_timesteps"], run.evaluation()["eval_freq"]
    if steps < every:
        raise ConfigError(
            f"a run of {steps} steps that is evaluated every {every} has no score; train longer "
            "(-n) or evaluate more often (--eval-freq)"
        )
    return int(steps // every)


class _Report(BaseCallback):
    """A callback that reports each evaluation to the study, whose pruner may stop the run.

    :param trial: the trial that the run belongs to
    :param scores: scores of the seeds that are done
    :param planned: evaluations of one seed
    :param seeds: runs of the trial
    """

    parent: Evaluation

    def __init__(self, trial: Trial, scores: Sequence[float], planned: int, seeds: int) -> None:
        super().__init__()
        self.trial, self.scores, self.planned, self.seeds = trial, list(scores), planned, seeds
        self.returns: list[float] = []

    def _on_step(self) -> bool:
        self.returns.append(float(self.parent.last_mean_reward))
        if len(self.returns) > self.planned:
            return True  # PPO's last rollout may pass the end
        step = len(self.scores) * self.planned + len(self.returns)
        self.trial.report(fmean([*self.scores, self.returns[-1]]), step)
        if step < self.planned * self.seeds and self.trial.should_prune():
            raise optuna.TrialPruned(f"after evaluation {step}")
        return True
