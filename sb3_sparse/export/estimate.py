"""Translates the estimate of the return that a policy's critics or scores make."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.graph import Output
from sb3_sparse.export.nodes import Add, Affine, Linear
from sb3_sparse.export.output_nodes import Largest, Minimum
from sb3_sparse.export.trace import Tracer
from sb3_sparse.export.traced_policy import TracedPolicy, module_of

OF_STATE = "the estimated return from the observation, V(s)"
OF_ACTION = "the estimated return from the observation and the action, Q(s, a)"


def value_output(traced: TracedPolicy) -> Output:
    """Return the output ``value``: V(s) where there is a value network, else Q(s, a).

    :raises UnsupportedError: if the policy does not say what estimates the return
    """
    declared, tracer = traced.declared, traced.tracer
    if declared.estimate == "output":
        extractor, *names = declared.valuing
        value = traced.features_of(extractor)
        for name in names:
            value = tracer.walk(module_of(traced.policy, name), value)
        return Output("value", value, (), OF_STATE)
    if declared.estimate == "largest":
        return Output("value", tracer.add(Largest((traced.result,), (1,))), (), OF_ACTION)
    if declared.estimate in ("min", "mean"):
        return Output("value", _of_critics(traced), (), OF_ACTION)
    raise UnsupportedError(
        f"{declared.__name__} does not say what estimates the return, so its value cannot be "
        "exported; declare its class attribute estimate, or leave out with_value (--with-value)"
    )


def _of_critics(traced: TracedPolicy) -> int:
    """Apply all critics to features and action, and take their minimum or mean."""
    extractor, critic = traced.declared.valuing
    tracer, mean = traced.tracer, traced.declared.estimate == "mean"
    read = tracer.concat([traced.features_of(extractor), traced.squashed])
    critics: Any = module_of(traced.policy, critic)
    estimates = [tracer.walk(network, read) for network in critics.q_networks]
    if mean:
        estimates = [_mean(tracer, value, len(estimates)) for value in estimates]
    kind = Add if mean else Minimum
    first, *others = estimates
    for value in others:
        first = tracer.add(kind((first, value), (1,)))
    return first


def _mean(tracer: Tracer, value: int, critics: int) -> int:
    """Return what a critic of quantiles contributes to the mean over all critics."""
    value = mean_quantiles(tracer, value, tracer.shape_of(value)[0])
    share = np.full(1, 1.0 / critics, np.float32)
    return tracer.add(Affine((value,), (1,), share, np.zeros(1, np.float32)))


def mean_quantiles(tracer: Tracer, value: int, quantiles: int) -> int:
    """Let the last layer compute the mean over quantiles, as QR-DQN and TQC do.

    :param quantiles: number of quantiles, each of which has all units of the result
    :raises UnsupportedError: if the last layer is not linear
    """
    last = tracer.nodes[value - 1]
    if not isinstance(last, Linear):
        raise UnsupportedError(
            "a quantile network cannot be exported if it does not end in a Linear layer, which "
            "takes the mean over quantiles; end it in one, or, if it is a critic, leave out "
            "with_value (--with-value)"
        )
    units = len(last.weight) // quantiles
    weight = last.weight.astype(np.float64).reshape(quantiles, units, -1).mean(axis=0)
    bias = last.bias.astype(np.float64).reshape(quantiles, units).mean(axis=0)
    tracer.nodes[value - 1] = Linear(
        last.inputs, (units,), weight.astype(np.float32), bias.astype(np.float32)
    )
    return value
