"""Optuna's samplers and pruners, by the names that rl-zoo uses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_sparse.errors import ConfigError, check_choice
from sb3_sparse.tuning.backend import FrozenTrial, optuna
from sb3_sparse.tuning.spaces import Space

BaseSampler = optuna.samplers.BaseSampler
BasePruner = optuna.pruners.BasePruner
TICKET = "sb3_sparse:ticket"  # which of the planned trials a trial is an attempt at
STARTUP_TRIALS = 5
REDUCTION = 3


def sampler_of(name: str, space: Space, seed: int) -> BaseSampler:
    """Make a sampler whose choices depend on seed, trial number and earlier trials only.

    So an interrupted search continues as if it had not been interrupted, and workers need no seeds
    of their own.

    :param name: ``"grid"``, ``"tpe"`` or ``"random"``
    :raises ConfigError: for another name, or for a grid over a space without choices
    """
    check_choice("sampler", name, SAMPLERS)
    return SAMPLERS[name](space, seed)


def _grid(space: Space, seed: int) -> BaseSampler:
    if space.grid is None:
        raise ConfigError(
            f"a grid needs choices, and the space {space.name!r} has ranges or a function; "
            "take --sampler tpe or random, or lists in the space"
        )
    return optuna.samplers.GridSampler(space.grid, seed=seed)


def _tpe(space: Space, seed: int) -> BaseSampler:
    def make(seed: int) -> BaseSampler:
        return optuna.samplers.TPESampler(seed=seed, constant_liar=True, n_startup_trials=10)

    return SeededByTrial(make, seed)


def _random(space: Space, seed: int) -> BaseSampler:
    return SeededByTrial(lambda seed: optuna.samplers.RandomSampler(seed=seed), seed)


SAMPLERS: dict[str, Callable[[Space, int], BaseSampler]] = {
    "grid": _grid,
    "tpe": _tpe,
    "random": _random,
}


def pruner_of(name: str, evaluations: int) -> BasePruner:
    """Make a pruner for trials that report a given number of evaluations.

    :param name: ``"none"``, ``"median"`` (after five whole trials, not in a trial's first third),
        ``"halving"`` (asynchronous successive halving: the best third continues after a ninth and
        after a third of the evaluations) or ``"hyperband"``
    :param evaluations: evaluations of a whole trial, over all its seeds
    :raises ConfigError: for another name
    """
    check_choice("pruner", name, PRUNERS)
    return PRUNERS[name](evaluations)


def _first_rung(evaluations: int) -> int:
    return max(1, evaluations // REDUCTION**2)


PRUNERS: dict[str, Callable[[int], BasePruner]] = {
    "none": lambda _: optuna.pruners.NopPruner(),
    "median": lambda evaluations: optuna.pruners.MedianPruner(
        STARTUP_TRIALS, n_warmup_steps=evaluations // 3
    ),
    "halving": lambda evaluations: optuna.pruners.SuccessiveHalvingPruner(
        min_resource=_first_rung(evaluations), reduction_factor=REDUCTION
    ),
    "hyperband": lambda evaluations: optuna.pruners.HyperbandPruner(
        min_resource=_first_rung(evaluations),
        max_resource=max(1, evaluations),
        reduction_factor=REDUCTION,
    ),
}


class SeededByTrial(BaseSampler):
    """A sampler that is made anew for each trial, with a seed of its own.

    :param make: makes a sampler from a seed
    :param seed: seed of the search
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

    def infer_relative_search_space(self, *args: Any, **kwargs: Any) -> Any:
        """Ask the trial's sampler."""
        return self._sampler.infer_relative_search_space(*args, **kwargs)

    def sample_relative(self, *args: Any, **kwargs: Any) -> Any:
        """Ask the trial's sampler."""
        return self._sampler.sample_relative(*args, **kwargs)

    def sample_independent(self, *args: Any, **kwargs: Any) -> Any:
        """Ask the trial's sampler."""
        return self._sampler.sample_independent(*args, **kwargs)

    def after_trial(self, *args: Any, **kwargs: Any) -> None:
        """Tell the trial's sampler."""
        self._sampler.after_trial(*args, **kwargs)
