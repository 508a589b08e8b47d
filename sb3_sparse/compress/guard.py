"""Decides from returns whether they have dropped too far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sb3_sparse import intervals
from sb3_sparse.errors import ConfigError


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % confidence interval.

    :param mean: the estimate
    :param low: lower end
    :param high: upper end
    """

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.2f} [{self.low:.2f}, {self.high:.2f}]"

    def share_of(self, whole: float) -> str:
        """Return the interval as signed percentages of ``|whole|``."""
        if whole == 0.0:
            return "of a return of 0"
        mean, low, high = (100 * value / abs(whole) for value in (self.mean, self.low, self.high))
        return f"{mean:+.2f} % [{low:+.2f} %, {high:+.2f} %]"


def mean_interval(values: Sequence[float]) -> Interval:
    """Return Student's t interval of a mean; for identical values, the value itself.

    :param values: two or more
    """
    assert len(values) >= 2
    return Interval(*map(float, intervals.mean_interval(values)))


def change(sparse: Sequence[float], baseline: Sequence[float]) -> Interval:
    """Estimate how much the mean return has changed, from pairs of episodes.

    Episodes of a pair start from the same seed and so share much of their luck. The interval of
    the paired differences is then narrower than Welch's of two independent samples; if nothing is
    shared, it only costs degrees of freedom.

    :param sparse: returns of the sparse model
    :param baseline: returns of the original model, in the same order
    """
    assert len(sparse) == len(baseline)
    return mean_interval(np.subtract(sparse, baseline).tolist())


def judge(change: Interval, tolerance: float) -> Literal["passed", "failed", "undecided"]:
    """Judge a drop: tolerable (passed), intolerable (failed) or undecided.

    :param change: change of the mean return
    :param tolerance: largest drop allowed, in units of the return, 0 or more
    """
    if change.low >= -tolerance:
        return "passed"
    return "failed" if change.high < -tolerance else "undecided"


def tolerance(baseline: Sequence[float], max_drop: float) -> float:
    """Return the largest drop allowed, in units of the return.

    :param baseline: returns of the original model
    :param max_drop: share of the absolute mean return
    :raises ConfigError: if the mean cannot be told from 0, so that a share of it means nothing
    """
    interval = mean_interval(baseline)
    if interval.low <= 0.0 <= interval.high:
        raise ConfigError(
            f"the model's return is {interval} over {len(baseline)} episodes, which cannot be told "
            f"from 0, so a drop by {max_drop:.2%} of it means nothing; give a fixed sparsity "
            "instead of a largest drop, or evaluate more episodes"
        )
    return max_drop * abs(interval.mean)
