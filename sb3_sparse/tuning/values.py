"""What a search varies, and the values that its trials had."""

from __future__ import annotations

from typing import Any

from sb3_sparse.pages.numbers import short
from sb3_sparse.sparsity.numeric import is_number
from sb3_sparse.tuning.backend import BaseDistribution, FrozenTrial
from sb3_sparse.tuning.search import Search
from sb3_sparse.tuning.spaces import CategoricalDistribution

WRITTEN, SAMPLED = 7, 3  # significant digits: what people write has fewer; what is shown else


def varied(search: Search) -> dict[str, BaseDistribution]:
    """Return the distributions of the hyperparameters that can have more than one value.

    Those of a space that is a function are the ones that its trials sampled from.
    """
    found = dict(search.definition.space.distributions)
    if not found:
        trials = search.status().complete
        found = {name: one for trial in trials for name, one in trial.distributions.items()}
    return {name: one for name, one in found.items() if not one.single()}


def choices_of(distribution: CategoricalDistribution) -> list[Any]:
    """Return the choices of a hyperparameter, numbers in order."""
    choices = list(distribution.choices)
    return sorted(choices) if all(map(is_number, choices)) else choices


def best_of(search: Search) -> FrozenTrial:
    """Return the best trial of a search that has a completed one."""
    best = search.status().best
    assert best is not None
    return best


def score_of(trial: FrozenTrial) -> float:
    """Return the score of a completed trial."""
    return float(trial.values[0])


def spelled(name: str) -> str:
    """Write a hyperparameter's name in words."""
    return name.replace("_", " ")


def value_text(value: Any) -> str:
    """Write a hyperparameter's value: a choice as it was written, a sampled one rounded."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        written = (digits for digits in range(1, WRITTEN) if float(f"{value:.{digits}g}") == value)
        return short(value, next(written, SAMPLED))
    return f"{value:,}" if isinstance(value, int) else str(value)
