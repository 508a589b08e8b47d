"""Distributions of actions, in terms of values of a program."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sb3_sparse.fused.values import Value

LARGEST = 3.4028234663852886e38
"""The largest float32."""
LOG_OF_ROOT_OF_TWO_PI = 0.5 * math.log(2.0 * math.pi)


def squashed_gaussian(
    mean: Value, log_std: Value, noise: Value, epsilon: float
) -> tuple[Value, Value]:
    """Sample a Gaussian and squash it by tanh; return the action and its log probability.

    Example::

        from sb3_sparse.fused import Program, squashed_gaussian

        program = Program()
        mean, log_std, noise = (program.input(name, 6) for name in ("mean", "log_std", "noise"))
        action, log_prob = squashed_gaussian(mean, log_std, noise, epsilon=1e-6)

    :param mean: means, ``[batch, dim]``
    :param log_std: logarithms of the standard deviations, ``[batch, dim]``
    :param noise: standard normal, ``[batch, dim]``
    :param epsilon: keeps the logarithm of the slope finite
    """
    action = (mean + log_std.exp() * noise).tanh()
    density = noise.square() * 0.5 + log_std + (1.0 - action.square() + epsilon).log()
    density = density + mean.detach() * 0.0  # NaN where the mean is infinite
    return action, -density.sum_features() - mean.features * LOG_OF_ROOT_OF_TWO_PI


def gaussian(mean: Value, log_std: Value, action: Value) -> tuple[Value, Value]:
    """Compute the log probability of an action, and the entropy.

    :param mean: means, ``[batch, dim]``
    :param log_std: logarithms of the standard deviations, ``[dim]``, for the whole batch
    :param action: ``[batch, dim]``
    """
    away = (action - mean) / log_std.exp()
    density = away.square() * 0.5 + log_std + LOG_OF_ROOT_OF_TWO_PI
    entropy = (log_std + (0.5 + LOG_OF_ROOT_OF_TWO_PI)).sum_features()
    return -density.sum_features(), entropy


def categorical(logits: Value, action: Value) -> tuple[Value, Value]:
    """Compute the log probability of an action, and the entropy.

    :param logits: ``[batch, actions]``
    :param action: numbers of the actions, ``[batch, 1]``
    """
    shifted = logits - logits.max_features()
    log_probs = shifted - shifted.exp().sum_features().log()
    finite = log_probs.clamp(-LARGEST, math.inf)  # impossible actions add nothing
    entropy = -(log_probs.exp() * finite).sum_features()
    return log_probs.pick(action), entropy


def multi_categorical(logits: Value, actions: Value, sizes: Sequence[int]) -> tuple[Value, Value]:
    """Compute the log probability and the entropy of several independent choices.

    :param logits: logits of all choices, one after the other
    :param actions: the number chosen in each, ``[batch, choices]``
    :param sizes: number of actions in each choice
    """
    found = []
    at = 0
    for i, size in enumerate(sizes):
        found.append(categorical(logits[at : at + size], actions.view(i, i + 1)))
        at += size
    log_prob, entropy = found[0]
    for one, two in found[1:]:
        log_prob, entropy = log_prob + one, entropy + two
    return log_prob, entropy


def bernoulli(logits: Value, actions: Value) -> tuple[Value, Value]:
    """Compute the log probability and the entropy of independent choices between 0 and 1.

    :param logits: ``[batch, choices]``
    :param actions: 0 or 1, ``[batch, choices]``
    """
    log_norm = logits.softplus()
    log_prob = (logits * actions - log_norm).sum_features()
    entropy = (log_norm - logits * logits.sigmoid()).sum_features()
    return log_prob, entropy


def least_of(values: Sequence[Value]) -> Value:
    """Compute the minimum of several values; of equal ones the first gets the gradient."""
    least = values[0]
    for value in values[1:]:
        least = least.first_least(value)
    return least
