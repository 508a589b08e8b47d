"""Interquartile means, probabilities of improvement and profiles by rliable; intervals of means.

All intervals are nominally at 95 %. How often they cover the truth was measured on 2,000 data sets
of normal scores, with the same number of seeds for each method:

=====  =====  ===================  ================  ====================
tasks  seeds  IQM (iqm_estimates)  plain difference  widened (difference)
=====  =====  ===================  ================  ====================
1      3      0.75                 0.80              0.95
1      5      0.90                 0.94              0.98
1      10     0.93                 0.95              0.97
5      3      0.87                 0.88              0.96
5      5      0.90                 0.92              0.96
5      10     0.92                 0.93              0.95
=====  =====  ===================  ================  ====================

So verdicts use the widened interval. The intervals of IQM figures are rliable's own, as published
work draws them, and too narrow for few seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from sb3_sparse.intervals import Array, mean_interval, t_quantile
from sb3_sparse.pages.numbers import counted
from sb3_sparse.report.backend import rliable_library

REPS, SEED, LEAST = 2000, 0, 2
MOST = 1000
NORMAL_975 = 1.959963984540054


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval.

    :param value: point estimate
    :param low: lower end; nan if there are too few data for an interval
    :param high: upper end
    :param seeds: runs of each task
    :param tasks: number of tasks
    """

    value: float
    low: float
    high: float
    seeds: int
    tasks: int = 1


@dataclass(frozen=True)
class Rectangle:
    """Scores as rliable expects them, with the same number of runs for each task.

    :param scores: shape ``[runs, tasks]``
    :param tasks: names of the columns
    :param remarks: what was left out
    """

    scores: Array
    tasks: tuple[str, ...]
    remarks: tuple[str, ...]


def rectangle(by_task: Mapping[str, Sequence[float]], least: int = LEAST) -> Rectangle | None:
    """Take the first k scores of each task, where k is the smallest number of runs of a task.

    :param by_task: scores of each task in the order of seeds, so that the choice does not depend on
        scores
    :param least: a task with fewer runs is left out, with a remark
    :return: None if no task is left
    """
    full = {task: scores for task, scores in by_task.items() if len(scores) >= least}
    remarks = [
        f"{task}: {counted(len(by_task[task]), 'run')}, of {least} needed"
        for task in by_task
        if task not in full
    ]
    if not full:
        return None
    count = min(map(len, full.values()))
    unused = {task: len(scores) - count for task, scores in full.items() if len(scores) > count}
    remarks += [
        f"{task}: {counted(more, 'run')} of the highest seeds not used"
        for task, more in unused.items()
    ]
    scores = np.array([list(scores)[:count] for scores in full.values()], dtype=np.float64).T
    return Rectangle(scores, tuple(full), tuple(remarks))


def iqm(scores: Array) -> float:
    """Return the mean of the middle half of all scores, as rliable does.

    :param scores: shape ``[runs, tasks]``
    """
    ordered = np.sort(scores, axis=None)
    cut = ordered.size // 4
    return float(ordered[cut : ordered.size - cut].mean())


def iqm_estimates(scores: Mapping[str, Array], reps: int = REPS) -> dict[str, Estimate]:
    """Return interquartile means with stratified bootstrap intervals, by method.

    :param scores: shape ``[runs, tasks]`` by method; two runs or more
    """
    return {
        name: _bootstrap(one, lambda x: np.array([iqm(x)]), reps) for name, one in scores.items()
    }


def improvement(better: Array, worse: Array, reps: int = REPS) -> Estimate:
    """Return the probability that a run of one method beats a run of another.

    It is the mean over tasks; ties count half.

    :param better: shape ``[runs, tasks]``
    :param worse: shape ``[runs, tasks]``, the same tasks
    """

    def probability(x: Array, y: Array) -> Array:  # rliable's metric, without a test per task
        return np.array([chances(x, y).mean()])

    return _bootstrap((better, worse), probability, reps)


def chances(better: Array, worse: Array) -> Array:
    """Return for each run of one method which share of another's runs it beats, ties half.

    :param better: shape ``[runs, tasks]``
    :param worse: shape ``[runs, tasks]``, the same tasks
    :return: mean over tasks, shape ``[runs of the one]``
    """
    above, same = better[:, None] > worse[None], better[:, None] == worse[None]
    shares: Array = (above + 0.5 * same).mean(axis=(1, 2))
    return shares


def profile(scores: Array, taus: Array, reps: int = REPS) -> tuple[Array, Array, Array]:
    """Return the share of runs with a score above each threshold, and the ends of its interval.

    :param scores: shape ``[runs, tasks]``
    :param taus: shape ``[n]``
    """
    with _seeded():
        values, ends = rliable_library.create_performance_profile(
            {"it": scores}, taus, custom_profile_func=_shares, reps=reps
        )
    return values["it"], ends["it"][0], ends["it"][1]


def difference(
    x: Array, y: Array, statistic: Callable[[Array], float] = iqm, reps: int = REPS
) -> Estimate:
    """Return by how much a method's statistic exceeds another's, with an interval for few seeds.

    The stratified bootstrap draws from n runs as if there were no others, so its interval is too
    narrow by sqrt((n - 1)/n), and it is normal where Student's t is due. Both ends are moved out by
    these factors. Source: Hesterberg 2015 (arXiv:1411.5279), section 3.2, applied to the ends
    themselves, because with 3 runs the tails of the bootstrap are too coarse for wider quantiles.

    :param x: shape ``[runs, tasks]``
    :param y: shape ``[other runs, tasks]``, the same tasks
    """

    def subtract(a: Array, b: Array) -> Array:
        return np.array([statistic(a) - statistic(b)])

    plain = _bootstrap((x, y), subtract, reps)
    least = min(len(x), len(y))
    factor = _widening(least, x.shape[1] * (len(x) + len(y) - 2))
    low = plain.value - factor * (plain.value - plain.low)
    high = plain.value + factor * (plain.high - plain.value)
    return Estimate(plain.value, float(low), float(high), least, x.shape[1])


def _widening(least: int, freedom: int) -> float:
    return float(np.sqrt(least / (least - 1)) * t_quantile(freedom) / NORMAL_975)


def seeds_for(estimate: Estimate, share: float) -> int | None:
    """Return the seeds with which an interval of :func:`difference` probably shrinks to a share.

    It shrinks with the square root of their number, and is widened less.

    :param estimate: a difference, of two sides with as many runs
    :param share: wanted length by today's, more than 0
    :return: None for more than 1,000
    """

    def length(seeds: int) -> float:
        return _widening(seeds, 2 * estimate.tasks * (seeds - 1)) / math.sqrt(seeds)

    wanted = share * length(estimate.seeds)
    return next((n for n in range(estimate.seeds, MOST + 1) if length(n) <= wanted), None)


def mean(values: Sequence[float]) -> Estimate:
    """Return the mean over seeds with Student's t interval; the ends are nan for a single seed."""
    middle, low, high = map(float, mean_interval(values))
    return Estimate(middle, low, high, len(values))


def mean_difference(x: Sequence[float], y: Sequence[float]) -> Estimate:
    """Return by how much a mean exceeds another, with Welch's t interval at 95 %.

    The two sides may have different numbers of seeds and different variances.

    :param x: scores of the one side
    :param y: scores of the other side
    :return: ``seeds`` are those of the scarcer side; the ends are nan if it has a single one
    """
    least = min(len(x), len(y))
    effect = float(np.mean(x) - np.mean(y))
    if least < 2:
        return Estimate(effect, float("nan"), float("nan"), least)
    parts = [float(np.var(side, ddof=1)) / len(side) for side in (x, y)]
    total = sum(parts)
    if total == 0:
        return Estimate(effect, effect, effect, least)
    weights = sum(v**2 / (len(side) - 1) for v, side in zip(parts, (x, y), strict=True))
    half = t_quantile(total**2 / weights) * math.sqrt(total)
    return Estimate(effect, effect - half, effect + half, least)


def _shares(scores: Array, taus: Array) -> Array:
    shares: Array = (scores.reshape(-1, 1) > taus).mean(axis=0)
    return shares


def _bootstrap(
    scores: Array | tuple[Array, Array], statistic: Callable[..., Array], reps: int
) -> Estimate:
    first = scores if isinstance(scores, np.ndarray) else scores[0]
    given = scores if isinstance(scores, np.ndarray) else list(scores)
    with _seeded():
        values, ends = rliable_library.get_interval_estimates({"it": given}, statistic, reps=reps)
    low, high = ends["it"][:, 0]
    return Estimate(float(values["it"][0]), float(low), float(high), len(first), first.shape[1])


@contextmanager
def _seeded() -> Iterator[None]:
    """Seed NumPy's global generator within the block, and restore it afterwards.

    rliable 1.2 takes a ``random_state`` but draws from the global generator.
    """
    before = np.random.get_state()
    np.random.seed(SEED)
    try:
        yield
    finally:
        np.random.set_state(before)
