"""Hooks that mask a layer's gradient and keep the dense one for methods that need it.

There are two, for two kinds of algorithm:

- Most algorithms call ``backward()``, perhaps on other losses too (SAC's actor loss fills the
  critics' gradients after their step). The optimizer applies the last gradient before its step.
- TRPO takes the actor's gradient with ``torch.autograd.grad``, which only a tensor hook sees: first
  with a graph (of the KL divergence), then the plain one of the objective, then Hessian products.
  The first plain gradient is the relevant one. Masked there, conjugate gradients and line search
  stay in the space of the active weights (but for TRPO's initial noise of about 1e-8).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any
from weakref import ref

import torch as th
from torch.utils.hooks import RemovableHandle

DenseGradient = Callable[[], th.Tensor]
"""Computes a dense gradient in the weight's shape when called."""


def weakly(hook: Any) -> Callable[[th.Tensor], Any]:
    """Wrap a hook so that it does not keep its object alive.

    Python's garbage collector cannot see through a tensor that torch's C++ side refers to. A hook
    that held the layer, and so its own weight, would keep every model forever.

    :param hook: a bound method
    """
    owner, function = ref(hook.__self__), hook.__func__  # quicker than weakref.WeakMethod

    def call(tensor: th.Tensor) -> Any:
        mask = owner()
        return None if mask is None else function(mask, tensor)

    return call


class GradientMask(ABC):
    """Hook on the gradient of one layer.

    :param capturing: tells whether the next step needs the dense gradient
    """

    def __init__(self, capturing: Callable[[], bool]) -> None:
        self.capturing = capturing
        self.dense_grad: DenseGradient | None = None

    @abstractmethod
    def attach(self) -> RemovableHandle:
        """Register the hook on the present weight."""

    @abstractmethod
    def take(self) -> DenseGradient | None:
        """Take the dense gradient that the optimizer is about to apply; None: no gradient."""
