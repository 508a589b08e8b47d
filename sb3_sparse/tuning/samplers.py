"""Optuna's samplers and pruners, by the names that rl-zoo uses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning.backend import BaseDistribution, FrozenTrial, TrialState, optuna
from sb3_sparse.tuning.choices import PRUNERS, SAMPLERS, check_choice
from sb3_sparse.tuning.spaces import Space

BaseSampler = optuna.samplers.BaseSampler
TICKET = "sb3_sparse:ticket"  # which of the study's planned trials a trial is an attempt at
STARTUP_TRIALS = 5
REDUCTION = 3


def sampler_of(name: str, space: Space, seed: int) -> BaseSampler:
    """A sampler whose choice for a trial depends on seed, trial number and earlier trials alone.

    So a study that was interrupted goes on as if it had not been, and workers need no seeds of
    their own.

    :param name: ``"grid"``, ``"tpe"`` or ``"random"``
    :raises ConfigError: for another name, or a grid over something that has no choices
    """
    check_choice("sampler", name, SAMPLERS)
    if name == "grid":
        if space.grid is None:
            raise ConfigError(
                f"a grid needs choices, and the space {space.name!r} has ranges or a function; "
                "take --sampler tpe or random, or lists in the space"
            )
        return optuna.samplers.GridSampler(space.grid, seed=seed)
    if name == "random":
        return SeededByTrial(lambda s: optuna.samplers.RandomSampler(seed=s), seed)
    return SeededByTrial(
        lambda s: optuna.samplers.TPESampler(seed=s, constant_liar=True, n_startup_trials=10), seed
    )


class SeededByTrial(BaseSampler):
    """Makes a sampler anew for each trial, with a seed of its own.

    :param make: makes a sampler from a seed
    :param seed: of the study
    """

    def __init__(self, make: Callable[[int], BaseSampler], seed: int) -> None:
        self._make, self._seed = make, seed
        self._sampler = make(seed)

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Make the trial's sampler."""
        number = trial.system_attrs.get(TICKET, trial.number)
        words = np.random.SeedSequence((self._seed, number)).generate_state(1)
        self._sampler = self._make(int(words[0]))
        self._sampler.before_trial(study, trial)

    def infer_relative_search_space(
        self, study: optuna.Study, trial: FrozenTrial
    ) -> dict[str, BaseDistribution]:
        """As the trial's sampler does."""
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        search_space: dict[str, BaseDistribution],
    ) -> dict[str, Any]:
        """As the trial's sampler does."""
        return self._sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """As the trial's sampler does."""
        return self._sampler.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self,
        study: optuna.Study,
        trial: FrozenTrial,
        state: TrialState,
        values: Sequence[float] | None,
    ) -> None:
        """As the trial's sampler does."""
        self._sampler.after_trial(study, trial, state, values)


def pruner_of(name: str, evaluations: int) -> optuna.pruners.BasePruner:
    """A pruner for trials that report so many evaluations.

    :param name: ``"none"``, ``"median"`` (after five whole trials, not in a trial's first third),
        ``"halving"`` (asynchronous successive halving: the best third goes on after a ninth of the
        evaluations, and after a third) or ``"hyperband"``
    :param evaluations: of a whole trial, over all its seeds
    :raises ConfigError: for another name
    """
    check_choice("pruner", name, PRUNERS)
    if name == "none":
        return optuna.pruners.NopPruner()
    if name == "median":
        return optuna.pruners.MedianPruner(STARTUP_TRIALS, n_warmup_steps=evaluations // 3)
    least = max(1, evaluations // REDUCTION**2)
    if name == "halving":
        return optuna.pruners.SuccessiveHalvingPruner(
            min_resource=least, reduction_factor=REDUCTION
        )
    return optuna.pruners.HyperbandPruner(
        min_resource=least, max_resource=max(evaluations, least), reduction_factor=REDUCTION
    )
