"""Masks and weights at the start."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.sparsity.randomness import random_bits, random_uniform
from sb3_sparse.sparsity.selection import largest


def random_mask(shape: Sequence[int], active: int, seed: int, name: str) -> NDArray[np.bool_]:
    """A mask with exactly ``active`` connections, uniformly at random.

    :param shape: the weight's shape
    :param active: nnz
    :param seed: mask seed
    :param name: the layer's name, so that layers and critics are independent of each other
    """
    size = math.prod(shape)
    mask = np.zeros(size, dtype=np.bool_)
    mask[largest(random_bits(seed, f"{name}/mask", size), active)] = True
    return mask.reshape(shape)


def glorot_limits(mask: NDArray[np.bool_], gain: float = 1.0) -> NDArray[np.float64]:
    """Bound of the uniform distribution of each connection, by the fans that are really there.

    ``L = gain * sqrt(3 / max(1, (fan_in + fan_out) / 2))`` with the active fan-in of the output
    unit and the active fan-out of the input unit, for convolutions summed over the window.

    :param mask: shape ``(out, in, *kernel)``
    :param gain: factor relative to Glorot's bound
    :return: shape ``(out, in, 1, ...)``, to be broadcast over the window

    Source: arXiv:2010.03533 scales by fan-in; the paper's text (arXiv:2206.10369) does too, its
    public code uses both fans. We follow the code.
    """
    window = tuple(range(2, mask.ndim))
    fan_in = mask.sum(axis=(1, *window), keepdims=True)
    fan_out = mask.sum(axis=(0, *window), keepdims=True)
    limits: NDArray[np.float64] = gain * np.sqrt(3.0 / np.maximum(1.0, (fan_in + fan_out) / 2.0))
    return limits


def sparsity_aware_weights(
    mask: NDArray[np.bool_], seed: int, name: str, gain: float = 1.0
) -> NDArray[np.float32]:
    """Weights drawn afresh, Glorot uniform on the sparse graph, 0 where inactive.

    :param mask: shape ``(out, in, *kernel)``
    :param seed: mask seed
    :param name: the layer's name
    :param gain: the gain with which SB3 initialises the layer, 1 where it has none
    """
    draws = random_uniform(seed, f"{name}/weight", mask.size).reshape(mask.shape)
    return np.where(mask, draws * glorot_limits(mask, gain), 0.0).astype(np.float32)
