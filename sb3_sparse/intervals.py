"""Means with Student's t intervals at 95 %."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_sparse.errors import MissingExtra

Array = npt.NDArray[np.float64]
CONFIDENCE = 0.95


def t_quantile(freedom: float) -> float:
    """Return by how many standard errors a 95 % interval reaches to either side.

    :param freedom: degrees of freedom, above 0
    """
    try:
        from scipy.special import stdtrit
    except ImportError as error:
        raise MissingExtra("an interval of Student's t", "zoo") from error
    return float(stdtrit(freedom, 0.5 + CONFIDENCE / 2))


def mean_interval(values: npt.ArrayLike) -> tuple[Any, Any, Any]:
    """Return the mean over the first axis, and the ends of its interval.

    :param values: shape ``[n, ...]``, float64
    :return: each of shape ``[...]``; the ends are nan for a single value
    """
    array: Array = np.asarray(values, dtype=np.float64)
    count, mean = len(array), array.mean(axis=0)
    if count < 2:
        return mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    half = t_quantile(count - 1) * (array.std(axis=0, ddof=1) / np.sqrt(count))
    return mean, mean - half, mean + half
