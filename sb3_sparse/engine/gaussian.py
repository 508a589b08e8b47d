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


def squashed(
    mean: th.Tensor,
    log_std: th.Tensor,
    bounds: tuple[float, float],
    noise: th.Tensor | None,
    result: th.Tensor,
) -> bool:
    """Actions of Gaussians behind a tanh; whether one is not finite.

    :param mean: shape ``(n, dim)``; float32 on the CPU and contiguous, as all
    :param log_std: the same shape; brought into its bounds in place
    :param bounds: of ``log_std``
    :param noise: of a standard normal distribution, shape ``(n, dim)``; None: the mean acts
    :param result: shape ``(2, n, dim)``: room for what is squashed, then for the actions
    """
    at = result.data_ptr()
    failed: int = library().sb3_sparse_squashed(
        mean.numel(),
        *bounds,
        mean.data_ptr(),
        log_std.data_ptr(),
        None if noise is None else noise.data_ptr(),
        at,
        at + 4 * mean.numel(),
    )
    return bool(failed)
