"""Schedules over the progress of training, i.e. environment steps done / planned."""

from __future__ import annotations

import math

from sb3_sparse.sparsity.distributions import floor_count


def cosine_drop_fraction(progress: float, drop_fraction: float, end: float) -> float:
    """Compute the share of a layer's connections that one update exchanges.

    Example::

        from sb3_sparse.sparsity import cosine_drop_fraction

        cosine_drop_fraction(progress=0.5, drop_fraction=0.4, end=1.0)  # 0.2

    :param progress: environment steps done / planned, in [0, 1]
    :param drop_fraction: the share at the start
    :param end: progress at which the share reaches 0

    Source: arXiv:1907.04840 and arXiv:1911.11134, section 3.
    """
    if progress >= end:
        return 0.0
    return drop_fraction / 2 * (1 + math.cos(math.pi * progress / end))


def pruned_count(
    size: int, initial: int, final: int, progress: float, begin: float, end: float
) -> int:
    """Compute the number of connections that gradual pruning leaves in a layer.

    The layer's sparsity rises from its initial to its final value along a cubic ramp.

    :param size: connections of the dense layer
    :param initial: nnz before pruning
    :param final: nnz after it
    :param progress: environment steps done / planned, in [0, 1]
    :param begin: progress at which pruning begins
    :param end: progress at which the final nnz is reached

    Source: arXiv:1710.01878 (Zhu and Gupta), section 3.
    """
    ramp = min(1.0, max(0.0, (progress - begin) / (end - begin)))
    zeros = (size - final) + (final - initial) * (1.0 - ramp) ** 3
    return size - floor_count(zeros)
