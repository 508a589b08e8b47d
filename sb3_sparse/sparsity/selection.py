"""Exact selection by score. Ties break towards the lowest index, so the choice is reproducible."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


def largest(scores: NDArray[Any], count: int) -> Indices:
    """Find the positions of the ``count`` largest scores, ascending. NaN counts as the smallest.

    Example::

        import numpy as np
        from sb3_sparse.sparsity import largest

        largest(np.array([0.1, 0.5, 0.3]), 2)  # array([1, 2])

    :param scores: shape ``(n,)``, any ordered dtype
    :param count: between 0 and n
    """
    assert 0 <= count <= scores.size
    if count == 0:
        return np.empty(0, dtype=np.int64)
    if count == scores.size:
        return np.arange(scores.size, dtype=np.int64)
    if scores.dtype.kind == "f":
        scores = np.where(np.isnan(scores), -np.inf, scores)
    threshold = np.partition(scores, scores.size - count)[scores.size - count]
    above = np.flatnonzero(scores > threshold)
    ties = np.flatnonzero(scores == threshold)[: count - above.size]
    return np.sort(np.concatenate([above, ties]))


def least_magnitude(weights: NDArray[np.float32], active: Indices, count: int) -> Indices:
    """Find the ``count`` active connections of least ``|weight|``, as ascending flat indices.

    :param weights: the layer's weights, shape ``(n,)``
    :param active: flat indices of its active connections, ascending
    :param count: between 0 and ``len(active)``
    """
    return active[largest(-np.abs(weights[active]), count)]
