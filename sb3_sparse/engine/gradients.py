"""Masks a layer's gradient as it arrives and keeps the dense one for a method that asks.

Two kinds of algorithm, two hooks:

- Most call ``backward()``, perhaps on other losses too (SAC's actor loss fills the critics'
  gradients after their step). The last gradient before the owning optimizer's step is the one it
  applies.
- TRPO takes the actor's gradient with ``torch.autograd.grad``, which only a tensor hook sees: first
  with a graph (of the KL divergence), then the plain one of the objective, then Hessian products.
  The first plain gradient is the one wanted. Masked there, conjugate gradients and line search work
  in the space of the active weights (but for the noise that TRPO starts them from, about 1e-8).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from weakref import ref

import torch as th
from torch.utils.hooks import RemovableHandle

if TYPE_CHECKING:
    from sb3_sparse.engine.layers import SparseLayer
    from sb3_sparse.engine.masked import MaskedLayer


DenseGradient = Callable[[], th.Tensor]
"""Gives a dense gradient in the weight's shape; what it costs, it costs when it is called."""


def weakly(hook: Any) -> Callable[[th.Tensor], Any]:
    """The hook without holding on to its object.

    Python's garbage collector does not see through a tensor that torch's C++ side refers to. A hook
    that held the layer, and so the weight that it hangs on, would keep every model for ever.

    :param hook: a bound method
    """
    owner, function = ref(hook.__self__), hook.__func__  # quicker than weakref.WeakMethod

    def call(tensor: th.Tensor) -> Any:
        mask = owner()
        return None if mask is None else function(mask, tensor)

    return call


def _kept(grad: th.Tensor) -> DenseGradient:
    return lambda: grad


class GradientMask(ABC):
    """Hook on the gradient of one layer.

    :param layer: the layer
    :param capturing: whether the dense gradient will be wanted at the next step
    """

    def __init__(self, layer: SparseLayer, capturing: Callable[[], bool]) -> None:
        self.layer = layer
        self.capturing = capturing
        self.dense_grad: DenseGradient | None = None

    @abstractmethod
    def attach(self) -> RemovableHandle:
        """Register the hook on the weight as it is now."""

    @abstractmethod
    def take(self) -> DenseGradient | None:
        """The dense gradient that the optimizer is about to apply, or None if there is none."""


class AccumulatedGradient(GradientMask):
    """For algorithms that call ``backward()``."""

    layer: MaskedLayer

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
        if layer.nnz != layer.size:
            grad.mul_(layer.float_mask)

    def take(self) -> DenseGradient | None:
        dense_grad, self.dense_grad = self.dense_grad, None
        return None if self.layer.weight.grad is None else dense_grad


class FunctionalGradient(GradientMask):
    """For algorithms that also use ``torch.autograd.grad``."""

    layer: MaskedLayer

    def attach(self) -> RemovableHandle:
        handle: RemovableHandle = self.layer.weight.register_hook(weakly(self._hook))  # type: ignore[no-untyped-call]
        return handle

    def _hook(self, grad: th.Tensor) -> th.Tensor | None:
        layer = self.layer
        full = layer.nnz == layer.size
        if self.dense_grad is None and not grad.requires_grad and self.capturing():
            # Where nothing is masked, the weight's gradient may become this very tensor.
            self.dense_grad = _kept(grad.clone() if full else grad)
        return None if full else grad * layer.float_mask

    def take(self) -> DenseGradient | None:
        dense_grad = self.dense_grad
        if self.layer.weight.grad is not None:  # else it stays that of the rollout
            self.dense_grad = None
        return dense_grad


def follow_mask(
    grad: th.Tensor | None,
    dense_grad: th.Tensor | None,
    old_mask: th.Tensor,
    new_mask: th.Tensor,
) -> None:
    """Bring the gradient that is about to be applied under a mask that has just changed.

    Grown connections get their dense gradient, scaled as clipping has scaled the others.

    :param grad: gradient under the old mask, perhaps clipped; changed in place. None: no step
    :param dense_grad: the same before masking and clipping; None if nothing can grow
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
