"""Share a network's sparsity among its layers.

Sources: uniform and ERK as in arXiv:1911.11134 (RigL), section 3; ER as in arXiv:1707.04780 (SET).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from sb3_sparse.errors import ConfigError, check_choice
from sb3_sparse.sparsity.numeric import as_float, is_number

Shape = Sequence[int]


def floor_count(value: float) -> int:
    """Floor that tolerates rounding: ``0.29 * 100`` gives 29, not 28.

    :param value: a count computed in floating point
    """
    return math.floor(value + 1e-6)


def check_sparsity(sparsity: float, what: str = "sparsity") -> float:
    """Validate a sparsity and return it as a float.

    :raises ConfigError: unless it is a number in [0, 1)
    """
    if not is_number(sparsity):
        raise ConfigError(f"{what} must be a number in [0, 1), got {sparsity!r}")
    if not 0.0 <= sparsity < 1.0:
        percent = f"; {sparsity:g} % is {sparsity / 100:g}" if 10 <= sparsity < 100 else ""
        raise ConfigError(
            f"{what} must lie in [0, 1) (it is the removed fraction of connections), got "
            f"{sparsity}{percent}"
        )
    return as_float(sparsity)


def _uniform(shapes: Sequence[Shape], sparsity: float) -> list[float]:
    return [sparsity] * len(shapes)


def _erdos_renyi(
    shapes: Sequence[Shape], sparsity: float, dims_of: Callable[[Shape], Sequence[int]]
) -> list[float]:
    """Densities proportional to ``sum(dims) / prod(dims)``, capped at 1.

    A layer whose share would exceed its size becomes dense, and the other layers share the rest,
    until no layer exceeds its size. Layers that tie for the largest score become dense together.
    """
    sizes = [math.prod(shape) for shape in shapes]
    zeros = [floor_count(sparsity * size) for size in sizes]
    scores = [sum(dims_of(shape)) / math.prod(dims_of(shape)) for shape in shapes]
    dense: set[int] = set()
    while len(dense) < len(shapes):
        free = [i for i in range(len(shapes)) if i not in dense]
        budget = sum(sizes[i] - zeros[i] for i in free) - sum(zeros[i] for i in dense)
        epsilon = budget / sum(scores[i] * sizes[i] for i in free)
        largest = max(scores[i] for i in free)
        if epsilon * largest <= 1.0:
            return [0.0 if i in dense else 1.0 - epsilon * scores[i] for i in range(len(shapes))]
        dense.update(i for i in free if scores[i] == largest)
    return [0.0] * len(shapes)


def _er(shapes: Sequence[Shape], sparsity: float) -> list[float]:
    return _erdos_renyi(shapes, sparsity, lambda shape: shape[:2])


def _erk(shapes: Sequence[Shape], sparsity: float) -> list[float]:
    return _erdos_renyi(shapes, sparsity, lambda shape: shape)


DISTRIBUTIONS: dict[str, Callable[[Sequence[Shape], float], list[float]]] = {
    "uniform": _uniform,
    "er": _er,
    "erk": _erk,
}


def check_distribution(distribution: str) -> str:
    """Validate the name of a distribution and return it.

    :raises ConfigError: if no distribution has that name
    """
    check_choice("distribution", distribution, sorted(DISTRIBUTIONS))
    return distribution


def active_counts(shapes: Sequence[Shape], sparsity: float, distribution: str = "erk") -> list[int]:
    """Compute the number of active connections in each layer of one network.

    A layer of ``N_l`` connections and sparsity ``s_l`` has exactly ``floor(s_l * N_l)`` zeros, but
    always keeps at least one connection.

    Example::

        from sb3_sparse.sparsity import active_counts

        active_counts([(256, 17), (256, 256), (6, 256)], sparsity=0.9)  # [1951, 3658, 1536]
        active_counts([(256, 17), (256, 256)], sparsity=0.9, distribution="uniform")  # [436, 6554]

    :param shapes: weight shapes in torch order: ``(out, in)`` or ``(out, in, *kernel)``
    :param sparsity: removed fraction of the network's connections, in [0, 1)
    :param distribution: ``"uniform"`` (the same sparsity in every layer), ``"erk"`` (Erdős–Rényi
        kernel) or ``"er"`` (the same without convolution windows)
    :return: nnz per layer, in the order of ``shapes``
    :raises ConfigError: for an invalid sparsity, distribution or shape

    Source: arXiv:1911.11134, section 3; convolution windows count as in arXiv:2206.10369.
    """
    sparsity = check_sparsity(sparsity)
    check_distribution(distribution)
    for shape in shapes:
        if len(shape) < 2 or any(dim < 1 for dim in shape):
            raise ConfigError(
                f"a weight shape needs two or more positive dimensions (out, in, ...), got "
                f"{shape!r}"
            )
    layer_sparsities = DISTRIBUTIONS[distribution](shapes, sparsity)
    counts = []
    for shape, layer_sparsity in zip(shapes, layer_sparsities, strict=True):
        size = math.prod(shape)
        counts.append(max(1, size - floor_count(layer_sparsity * size)))
    return counts
