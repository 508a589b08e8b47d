"""What a trial returned while it trained: evaluations of each seed, from what it reported."""

from __future__ import annotations

import numpy as np

from sb3_sparse.intervals import Array
from sb3_sparse.tuning.backend import FrozenTrial


def evaluations_of(trial: FrozenTrial, planned: int) -> Array:
    """Return the mean return of each evaluation of each seed.

    A trial reports the mean of the scores of its earlier seeds and of the return of this one
    (:class:`~sb3_sparse.tuning.Objective`), so the scores give the returns back.

    :param planned: evaluations of one seed
    :return: shape ``[seeds, planned]``; nan where there was no evaluation
    """
    scores = trial.user_attrs.get("scores", [])
    reported = trial.intermediate_values
    seeds = max((step - 1) // planned + 1 for step in reported) if reported else 0
    returns: Array = np.full((seeds, planned), np.nan)
    for step, value in reported.items():
        seed, place = divmod(step - 1, planned)
        returns[seed, place] = value * (seed + 1) - sum(scores[:seed])
    return returns


def curve_of(trial: FrozenTrial, planned: int) -> Array:
    """Return the mean over the seeds of each evaluation.

    Of a trial that was pruned these are the seeds that were trained farthest, so that a mean never
    changes its seeds on the way.

    :return: shape ``[evaluations]``: those that these seeds had
    """
    returns = evaluations_of(trial, planned)
    if not len(returns):
        return np.empty(0)
    counts = np.isfinite(returns).sum(axis=1)
    mean: Array = returns[counts == counts.max()].mean(axis=0)[: counts.max()]
    return mean
