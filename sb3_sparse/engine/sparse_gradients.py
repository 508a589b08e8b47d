"""Takes the dense gradients of layers in sparse storage from the kernels."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import torch as th
from torch import nn

from sb3_sparse.engine.gradients import DenseGradient, GradientMask, weakly
from sb3_sparse.engine.layer import SparseLayer


class StoredLayer(Protocol):
    """What it reads of a :class:`~sb3_sparse.engine.sparse.SparseStorage`."""

    @property
    def weight(self) -> nn.Parameter: ...

    @property
    def module(self) -> SparseLayer: ...


class SparseStorageGradient(GradientMask):
    """Takes a sparse layer's dense gradient from the kernels' backward pass.

    :param layer: the layer
    :param functional: whether the algorithm uses ``torch.autograd.grad``; if so, the first gradient
        counts, otherwise the last
    :param capturing: tells whether the next step needs the dense gradient
    """

    def __init__(self, layer: StoredLayer, functional: bool, capturing: Callable[[], bool]) -> None:
        super().__init__(capturing)
        self.layer = layer
        self.functional = functional
        self._arriving: list[DenseGradient] = []

    def attach(self) -> Any:
        self.layer.module.listener = self
        weight: Any = self.layer.weight
        return weight.register_post_accumulate_grad_hook(weakly(self._arrived))

    def wanted(self) -> bool:
        """Whether the next step needs the dense gradient, and it is not there yet."""
        return self.capturing() and not (self.functional and self.dense_grad is not None)

    def note(self, dense_grad: DenseGradient) -> None:
        """Keep a dense gradient; those of one backward pass add up."""
        if self.functional:
            self.dense_grad = dense_grad
        else:
            self._arriving.append(dense_grad)

    def _arrived(self, weight: th.Tensor) -> None:
        if self._arriving:
            assert weight.grad is not None
            # The gradient may include that of an earlier backward pass.
            active, flat = weight.grad.clone(), self.layer.module.structure.flat
            self.dense_grad = partial(_added_up, self._arriving, active, th.from_numpy(flat))
            self._arriving = []

    def take(self) -> DenseGradient | None:
        dense_grad, stepping = self.dense_grad, self.layer.weight.grad is not None
        if stepping or not self.functional:  # else keep that of the rollout
            self.dense_grad = None
        return dense_grad if stepping or self.functional else None


def _added_up(parts: list[DenseGradient], active: th.Tensor, flat: th.Tensor) -> th.Tensor:
    total = parts[0]()
    for part in parts[1:]:
        total += part()
    total.view(-1)[flat] = active
    return total
