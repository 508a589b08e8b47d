"""The outcome of a run, with the final evaluation of its policies."""

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
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.zoo.divergence import check_return
from sb3_sparse.zoo.folder import BEST
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.watch import Watch, counting

SCORED_SHARE = 0.1


@dataclass(frozen=True)
class Result:
    """The final evaluation of a policy.

    :param what: which policy of the run
    :param mean_return: mean episode return
    :param std_return: its standard deviation over episodes
    :param episodes: number of episodes
    :param path: the model's zip
    """

    what: str
    mean_return: float
    std_return: float
    episodes: int
    path: Path


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Example::

        from sb3_sparse.zoo import RunSpec, train

        outcome = train(RunSpec(n_timesteps=200, eval_freq=100, eval_episodes=1))
        if outcome.finished:
            print(outcome.results[0].mean_return, "at sparsity", outcome.sparsity)

    :param folder: the run's folder
    :param model: the model as the run left it
    :param results: evaluations of the last and the best policy; empty if the run was stopped
    """

    folder: Path
    model: BaseAlgorithm
    results: tuple[Result, ...]

    @property
    def finished(self) -> bool:
        """Whether the run reached its end."""
        return bool(self.results)

    @property
    def sparsity(self) -> float:
        """The model's current sparsity."""
        return self._policy.sparse.sparsity

    @property
    def wanted_sparsity(self) -> float:
        """The sparsity that the model's settings ask for."""
        layers = list(self._policy.sparse.layers)
        return 1.0 - sum(one.final_nnz for one in layers) / sum(one.size for one in layers)

    @property
    def _policy(self) -> BaseSparsePolicy:
        policy = unwrapped(self.model.policy)
        assert isinstance(policy, BaseSparsePolicy)
        return policy


def score_of(mean_returns: Sequence[float]) -> float:
    """Return a run's score: the mean over the last 10 % of its evaluations, at least one.

    :param mean_returns: mean episode return of each evaluation, in order

    Source: arXiv:2206.10369, section 3 (experimental details).
    """
    last = max(1, math.ceil(SCORED_SHARE * len(mean_returns) - 1e-9))
    return fmean(mean_returns[-last:])


def final_results(
    run: RunSpec,
    model: BaseAlgorithm,
    path: Path,
    envs: VecEnv,
    deterministic: bool,
    episodes: int,
    watch: Watch,
) -> tuple[Result, ...]:
    """Evaluate the last and the best policy on episodes that selected neither.

    :param path: the last policy's zip; the best one is beside it
    :param episodes: episodes for each policy, as many as in an evaluation during training
    :param watch: notified of each episode
    """
    if model.get_vec_normalize_env() is not None:
        assert model.env is not None
        sync_envs_normalization(model.env, envs)

    def result(what: str, path: Path) -> Result:
        def tell(done: int) -> None:
            watch.plays(f"Evaluating the {what.lower()}", done, episodes)

        envs.seed(run.seed + 10_000)
        tell(0)
        mean, std = evaluate_policy(
            model,
            envs,
            n_eval_episodes=episodes,
            deterministic=deterministic,
            callback=counting(tell),
        )
        assert not isinstance(mean, list)
        assert not isinstance(std, list)
        check_return(mean, model.num_timesteps)
        tell(episodes)
        return Result(what, float(mean), float(std), episodes, path)

    results = [result("Last policy", path)]
    best = path.with_name(BEST)
    if best.is_file():
        last: Any = deepcopy(model.get_parameters())
        with reading(best, "best model of this run", "remove it, and resume the run"):
            model.set_parameters(str(best))
        results.append(result("Best policy", best))
        model.set_parameters(last)
    return tuple(results)
