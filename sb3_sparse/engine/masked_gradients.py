"""Hooks that mask the gradient of a masked layer, and what a move does to the gradient."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch as th
from torch import nn
from torch.utils.hooks import RemovableHandle

from sb3_sparse.engine.gradients import DenseGradient, GradientMask, weakly


class MaskedLayer(Protocol):
    """What the hooks read of a :class:`~sb3_sparse.engine.masked.MaskedStorage`."""

    @property
    def weight(self) -> nn.Parameter: ...

    @property
    def float_mask(self) -> th.Tensor: ...

    @property
    def full(self) -> bool: ...


def _kept(grad: th.Tensor) -> DenseGradient:
    return lambda: grad


class MaskedGradient(GradientMask):
    """Hook on the gradient of a masked layer.

    :param layer: the layer
    :param capturing: tells whether the next step needs the dense gradient
    """

    def __init__(self, layer: MaskedLayer, capturing: Callable[[], bool]) -> None:
        super().__init__(capturing)
        self.layer = layer


class AccumulatedGradient(MaskedGradient):
    """Masks gradients of algorithms that call ``backward()``."""

    def attach(self) -> RemovableHandle:
        weight = self.layer.weight
        handle: RemovableHandle = weight.register_post_accumulate_grad_hook(weakly(self._hook))  # type: ignore[no-untyped-call]
        return handle

    def _hook(self, weight: th.Tensor) -> None:
        layer = self.layer
        grad = weight.grad
        assert grad is not None
        if self.capturing():
            self.dense_grad = _kept(grad.clone())
        if not layer.full:
            grad.mul_(layer.float_mask)

    def take(self) -> DenseGradient | None:
        dense_grad, self.dense_grad = self.dense_grad, None
        return None if self.layer.weight.grad is None else dense_grad


class FunctionalGradient(MaskedGradient):
    """Masks gradients of algorithms that also use ``torch.autograd.grad``."""

    def attach(self) -> RemovableHandle:
        handle: RemovableHandle = self.layer.weight.register_hook(weakly(self._hook))  # type: ignore[no-untyped-call]
        return handle

    def _hook(self, grad: th.Tensor) -> th.Tensor | None:
        layer = self.layer
        full = layer.full
        if self.dense_grad is None and not grad.requires_grad and self.capturing():
            # Where nothing is masked, the weight's gradient may become this very tensor.
            self.dense_grad = _kept(grad.clone() if full else grad)
        return None if full else grad * layer.float_mask

    def take(self) -> DenseGradient | None:
        dense_grad = self.dense_grad
        if self.layer.weight.grad is not None:  # else keep that of the rollout
            self.dense_grad = None
        return dense_grad


def follow_mask(
    grad: th.Tensor | None, dense_grad: th.Tensor | None, old_mask: th.Tensor, new_mask: th.Tensor
) -> None:
    """Adapt the gradient of the next step to a mask that has just changed.

    Grown connections get their dense gradient, scaled as clipping has scaled the others.

    :param grad: gradient under the old mask, perhaps clipped; changed in place. None: no step
    :param dense_grad: the gradient before masking and clipping; None if nothing can grow
    :param old_mask: 1.0 or 0.0
    :param new_mask: 1.0 or 0.0
    """
    if grad is None:
        return
    if dense_grad is None:
        grad.mul_(new_mask)
        return
    active = (dense_grad * old_mask).ravel()
    square = th.dot(active, active)
    scale = th.where(square > 0, th.dot(grad.ravel(), active) / square, 1.0)
    grad.copy_(th.where(old_mask.bool(), grad, scale * dense_grad) * new_mask)
