"""What comes out of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_sparse.loading.guard import reading
from sb3_sparse.zoo.divergence import check_return
from sb3_sparse.zoo.run import Run

FINAL_EPISODES = 20
SCORED_SHARE = 0.1


@dataclass(frozen=True)
class Result:
    """What came out.

    :param what: which policy of the run
    :param mean_return: mean episode return
    :param std_return: its standard deviation over episodes
    :param episodes: how many
    :param path: where the model lies
    """

    what: str
    mean_return: float
    std_return: float
    episodes: int
    path: Path


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    :param folder: the run's folder
    :param model: as it is now
    :param results: of the last policy and the best one; empty if the run was stopped before its end
    """

    folder: Path
    model: BaseAlgorithm
    results: tuple[Result, ...]

    @property
    def finished(self) -> bool:
        """Whether it came to its end."""
        return bool(self.results)


def score_of(mean_returns: Sequence[float]) -> float:
    """Score of a run: the mean over the last 10 % of its evaluations, and at least one.

    :param mean_returns: mean episode return of each evaluation, in order

    Source: arXiv:2206.10369, section 3 (experimental details).
    """
    last = max(1, math.ceil(SCORED_SHARE * len(mean_returns) - 1e-9))
    return fmean(mean_returns[-last:])


def final_results(
    run: Run, model: BaseAlgorithm, path: Path, envs: VecEnv, deterministic: bool
) -> tuple[Result, ...]:
    """Evaluate the last policy and the best one on episodes that neither was chosen by."""
    if model.get_vec_normalize_env() is not None:
        assert model.env is not None
        sync_envs_normalization(model.env, envs)
    results = [_evaluate("Last policy", run, model, path, envs, deterministic)]
    best = path.with_name("best_model.zip")
    if best.is_file():
        last: Any = deepcopy(model.get_parameters())
        with reading(best, "best model of this run", "remove it, and resume the run"):
            model.set_parameters(str(best))
        results.append(_evaluate("Best policy", run, model, best, envs, deterministic))
        model.set_parameters(last)
    return tuple(results)


def _evaluate(
    what: str, run: Run, model: BaseAlgorithm, path: Path, envs: VecEnv, deterministic: bool
) -> Result:
    envs.seed(run.seed + 10_000)
    mean, std = evaluate_policy(
        model, envs, n_eval_episodes=FINAL_EPISODES, deterministic=deterministic
    )
    assert not isinstance(mean, list)
    assert not isinstance(std, list)
    check_return(mean, model.num_timesteps)
    return Result(what, float(mean), float(std), FINAL_EPISODES, path)
