"""Find the dense network that has as many parameters as a sparse one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

from sb3_sparse.errors import ConfigError


def mlp_parameters(inputs: int, hidden: Sequence[int], outputs: int) -> int:
    """Count the weights and biases of a dense multi-layer perceptron."""
    return sum(a * b + b for a, b in pairwise([inputs, *hidden, outputs]))


def scaled_widths(hidden: Sequence[int], factor: float) -> list[int]:
    """Multiply every width by ``factor`` and round, to at least 1."""
    return [max(1, round(width * factor)) for width in hidden]


def equivalent_widths(
    hidden: Sequence[int], parameters: Callable[[list[int]], int], target: int
) -> tuple[list[int], int]:
    """Compute the hidden widths of the parameter-equivalent dense network.

    One factor scales all widths, such that the parameter count comes nearest to that of the sparse
    network; of two equally near networks the smaller is taken.

    Example::

        from sb3_sparse.sparsity import equivalent_widths, mlp_parameters

        equivalent_widths([256, 256], lambda hidden: mlp_parameters(17, hidden, 6), 7500)
        # ([75, 75], 7506)

    :param hidden: hidden widths of the full dense network
    :param parameters: gives the parameter count, biases included, for such widths; must not
        fall when a width grows
    :param target: parameter count of the sparse network (nnz and biases)
    :return: ``(widths, their parameter count)``
    :raises ConfigError: if the full network has fewer parameters than ``target``

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
