"""Distributions of actions, written with values of a program."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sb3_sparse.fused.values import Value

LARGEST = 3.4028234663852886e38
"""Of the numbers of single precision."""
LOG_OF_ROOT_OF_TWO_PI = 0.5 * math.log(2.0 * math.pi)


def squashed_gaussian(
    mean: Value, log_std: Value, noise: Value, epsilon: float
) -> tuple[Value, Value]:
    """A sample of a Gaussian behind a tanh, and its log probability.

    :param noise: of a standard normal distribution
    :param epsilon: keeps the logarithm of the slope finite
    """
    action = (mean + log_std.exp() * noise).tanh()
    density = noise.square() * 0.5 + log_std + (1.0 - action.square() + epsilon).log()
    density = density + mean.detach() * 0.0  # around an infinite mean there is none
    return action, -density.sum_features() - mean.features * LOG_OF_ROOT_OF_TWO_PI


def gaussian(mean: Value, log_std: Value, action: Value) -> tuple[Value, Value]:
    """Log probability of an action, and the entropy.

    :param log_std: the same for the whole batch
    """
    away = (action - mean) / log_std.exp()
    density = away.square() * 0.5 + log_std + LOG_OF_ROOT_OF_TWO_PI
    entropy = (log_std + (0.5 + LOG_OF_ROOT_OF_TWO_PI)).sum_features()
    return -density.sum_features(), entropy


def categorical(logits: Value, action: Value) -> tuple[Value, Value]:
    """Log probability of an action, and the entropy.

    :param action: its number
    """
    shifted = logits - logits.max_features()
    log_probs = shifted - shifted.exp().sum_features().log()
    finite = log_probs.clamp(-LARGEST, math.inf)  # what is impossible adds nothing
    entropy = -(log_probs.exp() * finite).sum_features()
    return log_probs.pick(action), entropy


def multi_categorical(logits: Value, actions: Value, sizes: Sequence[int]) -> tuple[Value, Value]:
    """The same of several choices at once.

    :param sizes: how many actions each has
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
    """The same of independent choices between 0 and 1."""
    log_norm = logits.softplus()
    log_prob = (logits * actions - log_norm).sum_features()
    entropy = (log_norm - logits * logits.sigmoid()).sum_features()
    return log_prob, entropy


def least_of(values: Sequence[Value]) -> Value:
    """The least of several; where some are equal the gradient is the first one's."""
    least = values[0]
    for value in values[1:]:
        least = least.first_least(value)
    return least
