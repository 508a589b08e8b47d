"""Norms of a layer's input that the kernels compute: LayerNorm, and sb3-contrib's BatchRenorm."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn

NORMS: list[type[nn.Module]] = [nn.LayerNorm]
"""Types of norms; :mod:`sb3_sparse.policies.contrib` adds its BatchRenorm."""


def features_of(norm: Any) -> tuple[int, ...]:
    """Return the shape that a norm expects of each entry."""
    return norm.normalized_shape if isinstance(norm, nn.LayerNorm) else (norm.num_features,)


def tensors_of_norm(norm: Any) -> tuple[th.Tensor | None, ...]:
    """Return scale, shift, and running mean and variance; None where there is none."""
    if norm is None:
        return (None,) * 4
    if isinstance(norm, nn.LayerNorm):
        return norm.weight, norm.bias, None, None
    return norm.scale, norm.bias, norm.ra_mean, norm.ra_var


def settings_of_norm(norm: Any) -> tuple[Any, ...]:
    """Return what the kernels take of a norm besides its tensors."""
    return (norm.eps,) if isinstance(norm, nn.LayerNorm) else (norm.eps, is_ready(norm))


def training_settings_of(norm: Any) -> tuple[Any, ...]:
    """Return what a recorded gradient step takes of a norm besides its tensors."""
    if isinstance(norm, nn.LayerNorm):
        return (norm.eps,)
    return norm.eps, norm.momentum, norm.affine, norm.rmax, norm.dmax


def is_warm(norm: Any) -> bool:
    """Whether a BatchRenorm is behind its warm-up, and normalises by its running statistics too."""
    return bool(norm.steps.item() > norm.warmup_steps)


def is_ready(norm: Any) -> bool:
    """Whether the kernels can apply a norm when a network acts: not while it learns statistics."""
    return isinstance(norm, nn.LayerNorm) or (norm.affine and not norm.training)
