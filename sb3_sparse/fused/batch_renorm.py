"""BatchRenorm, which normalises each feature over the batch."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch as th

from sb3_sparse.engine.norms import is_warm
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.values import Back, Value

Statistics = list[tuple[th.Tensor, Value]]
"""Running statistics of a norm, each with its next value."""


def by_running_statistics(norm: Any, x: Value) -> Value:
    """Normalise as BatchRenorm does outside of training.

    :param norm: sb3-contrib's ``BatchRenorm1d``
    :param x: ``[batch, features]``
    :return: ``[batch, features]``
    :raises NotCovered: if the norm has another number of features, or no scale and bias
    """
    scale, bias, mean, variance = _tensors(norm, x)
    return _scaled(_centred(x, mean), scale / (variance + norm.eps).sqrt(), bias)


def renormalised(norm: Any, batches: list[Value]) -> tuple[list[Value], Statistics]:
    """Normalise as BatchRenorm does in training, on the entries of one batch or two.

    Features that are the same in all entries get no gradient after the warm-up, where that of
    sb3-contrib is NaN.

    :param norm: sb3-contrib's ``BatchRenorm1d``
    :param batches: each ``[batch, features]``
    :return: each batch normalised, and the norm's next running statistics
    :raises NotCovered: as :func:`by_running_statistics`

    Source: arXiv:1702.03275.
    """
    program: Any = batches[0].program
    scale, bias, running_mean, running_variance = _tensors(norm, batches[0])
    warm = is_warm(norm)
    constant: list[Value] = []
    if warm:
        batches = [_without_gradient_of(constant, x) for x in batches]
    mean = _mean(batches)
    centred = [_centred(x, mean) for x in batches]
    degrees_of_freedom = program.scalar("batch - 1")
    if len(batches) > 1:
        degrees_of_freedom = (degrees_of_freedom + 1.0) * float(len(batches)) - 1.0
    variance = _squares(centred) / degrees_of_freedom
    deviation = (variance + norm.eps).sqrt()
    if warm:
        constant.append(variance.same(0.0))
        running = (running_variance + norm.eps).sqrt()
        ratio = (deviation / running).detach().clamp(1 / norm.rmax, norm.rmax)
        shift = ((mean - running_mean) / running).detach().clamp(-norm.dmax, norm.dmax)
        factor = scale / (variance / ratio.square() + norm.eps).sqrt()
        bias = shift * _root(variance) / ratio * factor + bias
    else:
        factor = scale / deviation
    next_statistics = [
        (norm.ra_mean, running_mean + (mean - running_mean) * norm.momentum),
        (norm.ra_var, running_variance + (variance - running_variance) * norm.momentum),
    ]
    return [_scaled(x, factor, bias) for x in centred], next_statistics


def _tensors(norm: Any, x: Value) -> tuple[Value, Value, Value, Value]:
    """Return scale, bias, and running mean and variance of a norm.

    :raises NotCovered: if it does not fit its input, or has no scale and bias
    """
    if norm.num_features != x.features:
        raise NotCovered(f"a BatchRenorm of {norm.num_features} features gets {x.features}")
    if not norm.affine:
        raise NotCovered("a BatchRenorm that is not affine")
    program: Any = x.program
    tensors = norm.scale, norm.bias, norm.ra_mean, norm.ra_var
    scale, bias, mean, variance = map(program.parameter, tensors)
    return scale, bias, mean, variance


# Functions whose gradients are sums over the batch, which these operations compute quickly


def _filled(g: Value) -> Value:
    """Repeat numbers for each entry of the batch; 0 beyond its end."""
    made = Value(g.program, g.features, True)
    g.program.record("FILL", made, g)
    return made


def _mean(batches: list[Value]) -> Value:
    program, features = batches[0].program, batches[0].features
    made = Value(program, features, False)

    share = _once(lambda g: _filled(g * (program.scalar("1 / batch") * (1.0 / len(batches)))))
    made.parents = tuple((x, share) for x in batches)
    program.record("MEAN_BATCH", made, *batches, tiled=False)
    return made


def _squares(batches: list[Value]) -> Value:
    """Sum the squares of all entries."""
    sums = [_dot(x, x) for x in batches]
    made = sum(sums[1:], sums[0]).detach()
    twice = _once(lambda g: _filled(g * 2.0))
    made.parents = tuple((x, partial(_times, x, twice)) for x in batches)
    return made


def _times(x: Value, of_gradient: Back, g: Value) -> Value:
    return x * of_gradient(g)


def _once(make: Back) -> Back:
    """Share what is made of a gradient among several parents."""
    made: dict[Value, Value] = {}
    return lambda g: made[g] if g in made else made.setdefault(g, make(g))


def _dot(x: Value, y: Value) -> Value:
    """Sum the products of two batches over the batch, without a gradient."""
    made = Value(x.program, x.features, False)
    x.program.record("DOT_BATCH", made, x, y, tiled=False)
    return made


def _sum_over_batch(g: Value) -> Value:
    return _dot(g, g.program.constant(1.0))


def _centred(x: Value, mean: Value) -> Value:
    made = Value(
        x.program, x.features, True, ((x, lambda g: g), (mean, lambda g: -_sum_over_batch(g)))
    )
    x.program.record("SUBTRACT", made, x, mean)
    return made


def _scaled(x: Value, factor: Value, shift: Value) -> Value:
    made = Value(x.program, x.features, True)
    made.parents = (
        (x, lambda g: g * factor),
        (factor, lambda g: _dot(g, x)),
        (shift, _sum_over_batch),
    )
    x.program.record("MULTIPLY_ADD", made, x, factor, shift)
    return made


def _root(x: Value) -> Value:
    """Compute the square root; 0 has the gradient 0."""
    made = x.sqrt()
    made.parents = ((x, lambda g: g * 0.5 / (made + made.same(0.0))),)
    return made


def _without_gradient_of(constant: list[Value], x: Value) -> Value:
    """Pass on the gradient of the features that are not constant, which is known later."""
    made = x.detach()
    made.parents = ((x, lambda g: g * (1.0 - constant[0])),)
    return made
