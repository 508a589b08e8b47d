"""The dense network that has as many parameters as a sparse one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

from sb3_sparse.errors import ConfigError


def mlp_parameters(inputs: int, hidden: Sequence[int], outputs: int) -> int:
    """Weights and biases of a dense multi-layer perceptron."""
    return sum(a * b + b for a, b in pairwise([inputs, *hidden, outputs]))


def scaled_widths(hidden: Sequence[int], factor: float) -> list[int]:
    """Every width times ``factor``, rounded, at least 1."""
    return [max(1, round(width * factor)) for width in hidden]


def equivalent_widths(
    hidden: Sequence[int], parameters: Callable[[list[int]], int], target: int
) -> tuple[list[int], int]:
    """Hidden widths of the parameter-equivalent dense network.

    One factor scales all widths; it is searched so that the whole parameter count comes nearest to
    the sparse network's (a tie goes to the smaller network).

    :param hidden: hidden widths of the full dense network
    :param parameters: whole parameter count (biases included) as a function of the widths;
        must not fall when a width grows
    :param target: parameter count of the sparse network (nnz and biases)
    :return: ``(widths, their parameter count)``
    :raises ConfigError: if even the full network has fewer parameters than ``target``

    Source: arXiv:2206.10369, section on the experimental setup.
    """
    full = parameters(list(hidden))
    if target > full:
        raise ConfigError(
            f"the target of {target} parameters is above the {full} of the full network "
            f"{list(hidden)}; a parameter-equivalent dense network can only be smaller"
        )
    if target == full:
        return list(hidden), full
    low, high = 0.0, 1.0
    while scaled_widths(hidden, low) != scaled_widths(hidden, high):
        middle = (low + high) / 2
        if middle in (low, high):
            break
        if parameters(scaled_widths(hidden, middle)) <= target:
            low = middle
        else:
            high = middle
    candidates = [scaled_widths(hidden, factor) for factor in (low, high)]
    best = min(candidates, key=lambda widths: abs(parameters(widths) - target))
    return best, parameters(best)
