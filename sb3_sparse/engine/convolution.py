"""A convolution that stores its active connections only."""

from __future__ import annotations

from functools import partial
from typing import Any
from weakref import ref

import torch as th
from torch import nn
from torch.nn import functional

from sb3_sparse.engine.chains import watched
from sb3_sparse.engine.internals import is_batched
from sb3_sparse.engine.layer import SparseLayer, dense_weight
from sb3_sparse.engine.structure import Structure


class SparseConv2d(SparseLayer, nn.Conv2d):
    """``nn.Conv2d`` on its active connections, whose dense weight is ``(out, in, height, width)``.

    ``structure`` has the shape ``(out, in * height * width)``: a flat index is that of the weight.
    """

    dense_class = nn.Conv2d
    weight: nn.Parameter

    @classmethod
    def takes(cls, module: nn.Module) -> bool:
        """Whether a module is a convolution without groups, dilation and padding but by zeros."""
        return (
            type(module) is nn.Conv2d
            and module.groups == 1
            and module.dilation == (1, 1)
            and module.padding_mode == "zeros"
            and not isinstance(module.padding, str)
        )

    @property
    def dense_shape(self) -> tuple[int, ...]:
        return self.out_channels, self.in_channels, *self.kernel_size

    def forward(self, input: th.Tensor) -> th.Tensor:
        """Apply the layer, as ``nn.Conv2d`` does."""
        acting = not th.is_grad_enabled() and not watched(input)
        structure, values = self.held() if acting else self.live()
        return self.by_dense_weight(input, structure, values)

    def by_dense_weight(
        self, input: th.Tensor, structure: Structure, values: th.Tensor
    ) -> th.Tensor:
        """Compute the result by a dense weight, which torch can differentiate repeatedly."""
        weight = dense_weight(structure, values, self.dense_shape)
        if weight.requires_grad and self.listener is not None:
            weight.register_hook(partial(_note, ref(self)))  # type: ignore[no-untyped-call]
        return functional.conv2d(input, weight, self.bias, self.stride, self.padding)


def _note(layer: Any, grad: th.Tensor) -> None:
    """Give the gradient of a layer's dense weight to whom it may concern.

    :param layer: a weak reference: a graph must not hold the layer
    """
    listener = None if (module := layer()) is None else module.listener
    if th.is_grad_enabled() or is_batched(grad):
        return  # this pass is one of several, such as that of TRPO's KL divergence
    if listener is not None and listener.wanted():
        listener.note(partial(grad.clone, memory_format=th.contiguous_format))
