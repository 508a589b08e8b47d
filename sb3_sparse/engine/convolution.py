"""A convolution that stores its active connections only."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_sparse.engine.image_layout import ImageStep, Window
from sb3_sparse.engine.images import ImageChain
from sb3_sparse.engine.layer import SparseLayer


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
        step = ImageStep(Window.of(self), self.dense_shape, None, 0, 0, 1)
        return ImageChain([step], [self])(input)
