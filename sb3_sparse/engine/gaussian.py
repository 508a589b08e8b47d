"""Samples of Gaussians and their log probabilities, in one call of the kernels."""

from __future__ import annotations

import torch as th

from sb3_sparse.engine.native.library import library


def gaussian(
    mean: th.Tensor, log_std: th.Tensor, noise: th.Tensor | None, result: th.Tensor
) -> bool:
    """Actions of Gaussians and their log probabilities; whether one is not finite.

    :param mean: shape ``(n, dim)``; float32 on the CPU and contiguous, as all
    :param log_std: shape ``(dim,)``
    :param noise: of a standard normal distribution, shape ``(n, dim)``; None: the mean acts
    :param result: shape ``(n * dim + n,)``: room for the actions, then for the log probabilities
    """
    n, size = mean.shape
    at = result.data_ptr()
    failed: int = library().sb3_sparse_gaussian(
        n,
        size,
        mean.data_ptr(),
        log_std.data_ptr(),
        None if noise is None else noise.data_ptr(),
        at,
        at + 4 * n * size,
    )
    return bool(failed)
