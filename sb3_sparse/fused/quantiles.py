"""What algorithms that learn quantiles need: their order, their sums, the best action, the loss."""

from __future__ import annotations

from sb3_sparse.fused.values import Value


def sort(x: Value) -> Value:
    """Sort the features of each entry, the smallest first; NaN is greater than all.

    :return: ``[batch, features]``, without a gradient
    """
    return _over_features("SORT", x, x.features)


def argmax(x: Value) -> Value:
    """Find the number of the largest feature, the first of equal ones.

    :return: ``[batch, 1]``, without a gradient
    """
    return _over_features("ARGMAX", x, 1)


def sum_blocks(x: Value, size: int) -> Value:
    """Sum consecutive blocks of features.

    :param size: features of a block
    :return: ``[batch, size]``, without a gradient
    :raises ValueError: if the features cannot be divided into such blocks
    """
    x.blocks_of(size)
    return _over_features("SUM_FEATURES", x, size)


def quantile_huber(estimates: Value, targets: Value) -> Value:
    """Compute the quantile Huber loss of each estimate, summed over the targets.

    Example::

        from sb3_sparse.fused import Program, quantile_huber

        program = Program()
        estimates, targets = program.input("estimates", 25), program.input("targets", 46)
        loss = quantile_huber(estimates, targets.detach()).mean() * (1 / targets.features)

    :param estimates: evenly spaced quantiles, ``[batch, quantiles]``
    :param targets: samples of the distribution that has these quantiles, ``[batch, samples]``; they
        get no gradient
    :return: ``[batch, quantiles]``

    Source: arXiv:1710.10044, equation 10.
    """
    count = estimates.features
    both = Value(estimates.program, 2 * count, True)  # losses, then their derivatives
    estimates.program.record(
        "QUANTILE_HUBER", both, estimates, targets, first=count, last=targets.features
    )
    loss, slope = both.view(0, count), both.view(count, 2 * count)
    loss.parents = ((estimates, lambda g: g * slope),)
    return loss


def _over_features(kind: str, x: Value, features: int) -> Value:
    made = Value(x.program, features, x.batched)
    x.program.record(kind, made, x, first=x.features)
    return made
