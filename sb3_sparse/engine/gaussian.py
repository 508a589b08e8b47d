"""Gaussian samples and their log probabilities, in one call of the kernels."""

from __future__ import annotations

import torch as th

from sb3_sparse.engine.buffer import FloatBuffer
from sb3_sparse.engine.native.library import library


def sample_gaussian(
    mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor | None
) -> tuple[th.Tensor, th.Tensor] | None:
    """Compute actions ``(n, dim)`` and their log probabilities ``(n,)``; None if one is not finite.

    All arguments are contiguous float32 tensors on the CPU.

    :param mean: shape ``(n, dim)``
    :param log_std: shape ``(dim,)``
    :param noise: standard normal, shape ``(n, dim)``; None: the mean is the action
    """
    n, size = mean.shape
    buffer = FloatBuffer(n * size + n)
    drawn = None if noise is None else noise.data_ptr()
    call = library().sb3_sparse_gaussian
    if call(n, size, mean.data_ptr(), log_std.data_ptr(), drawn, buffer.memory):
        return None
    return buffer.tensor((n, size), 0), buffer.tensor((n,), n * size)


def sample_squashed(
    mean: th.Tensor, log_std: th.Tensor, bounds: tuple[float, float], noise: th.Tensor | None
) -> tuple[th.Tensor, th.Tensor] | None:
    """Compute Gaussian samples and their tanh, both of the mean's shape; None if not finite.

    All tensors are contiguous float32 on the CPU.

    :param mean: shape ``(n, dim)``
    :param log_std: shape ``(n, dim)``; clamped to its bounds in place
    :param bounds: bounds of ``log_std``
    :param noise: standard normal, shape ``(n, dim)``; None: the mean is the sample
    """
    size = mean.numel()
    buffer = FloatBuffer(2 * size)
    drawn = None if noise is None else noise.data_ptr()
    call = library().sb3_sparse_squashed
    if call(size, *bounds, mean.data_ptr(), log_std.data_ptr(), drawn, buffer.memory):
        return None
    return buffer.tensor(mean.shape, 0), buffer.tensor(mean.shape, size)
