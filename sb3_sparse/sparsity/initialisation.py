"""Initial masks and weights."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.sparsity.randomness import random_bits, random_uniform
from sb3_sparse.sparsity.selection import largest


def random_mask(shape: Sequence[int], active: int, seed: int, name: str) -> NDArray[np.bool_]:
    """Draw a mask with exactly ``active`` connections, uniformly at random.

    Example::

        from sb3_sparse.sparsity import random_mask

        random_mask((256, 17), active=435, seed=0, name="actor.latent_pi.0").sum()  # 435

    :param shape: the weight's shape
    :param active: nnz
    :param seed: mask seed
    :param name: the layer's name, which makes layers and critics independent
    """
    size = math.prod(shape)
    mask = np.zeros(size, dtype=np.bool_)
    mask[largest(random_bits(seed, f"{name}/mask", size), active)] = True
    return mask.reshape(shape)


def glorot_limits(mask: NDArray[np.bool_], gain: float = 1.0) -> NDArray[np.float64]:
    """Compute the bound of each connection's uniform distribution from its active fans.

    ``L = gain * sqrt(3 / max(1, (fan_in + fan_out) / 2))`` with the active fan-in of the output
    unit and the active fan-out of the input unit; convolutions sum over the window.

    :param mask: shape ``(out, in, *kernel)``
    :param gain: factor relative to Glorot's bound
    :return: shape ``(out, in, 1, ...)``, which broadcasts over the window

    Source: arXiv:2010.03533 scales by fan-in, as does the text of arXiv:2206.10369; the public code
    of the latter uses both fans, and so does this function.
    """
    window = tuple(range(2, mask.ndim))
    fan_in = mask.sum(axis=(1, *window), keepdims=True)
    fan_out = mask.sum(axis=(0, *window), keepdims=True)
    limits: NDArray[np.float64] = gain * np.sqrt(3.0 / np.maximum(1.0, (fan_in + fan_out) / 2.0))
    return limits


def sparsity_aware_weights(
    mask: NDArray[np.bool_], seed: int, name: str, gain: float = 1.0, number: int = 0
) -> NDArray[np.float32]:
    """Draw Glorot uniform weights for a sparse layer, 0 where inactive.

    :param mask: shape ``(out, in, *kernel)``
    :param seed: mask seed
    :param name: the layer's name
    :param gain: SB3's gain for the layer; 1 if it has none
    :param number: distinguishes draws of one layer, e.g. the gradient step; 0: the first
    """
    draws = random_uniform(seed, f"{name}/weight", mask.size, number).reshape(mask.shape)
    return np.where(mask, draws * glorot_limits(mask, gain), 0.0).astype(np.float32)
