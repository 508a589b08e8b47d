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
from typing import Any
from weakref import ref

import torch as th
from torch.utils.hooks import RemovableHandle

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


class GradientMask(ABC):
    """Hook on the gradient of one layer.

    :param capturing: whether the dense gradient will be wanted at the next step
    """

    def __init__(self, capturing: Callable[[], bool]) -> None:
        self.capturing = capturing
        self.dense_grad: DenseGradient | None = None

    @abstractmethod
    def attach(self) -> RemovableHandle:
        """Register the hook on the weight as it is now."""

    @abstractmethod
    def take(self) -> DenseGradient | None:
        """The dense gradient that the optimizer is about to apply, or None if there is none."""
