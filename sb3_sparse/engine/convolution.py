"""A convolution that stores its active connections only."""

from __future__ import annotations

from copy import deepcopy
from math import prod
from operator import attrgetter
from typing import Any

import torch as th
from torch import nn

from sb3_sparse.engine.image_step import ImageStep, Window
from sb3_sparse.engine.images import ImageChain
from sb3_sparse.engine.layer import SparseLayer
from sb3_sparse.errors import UnsupportedError

convolution_attributes = attrgetter(
    "in_channels", "out_channels", "kernel_size", "stride", "padding", "dilation", "groups",
    "padding_mode",
)  # fmt: skip
"""What a convolution is set to, which the user may change."""


def _is_plain(module: nn.Conv2d) -> bool:
    return (
        module.groups == 1
        and module.dilation in (1, (1, 1))
        and module.padding_mode == "zeros"
        and not isinstance(module.padding, str)
    )


class SparseConv2d(SparseLayer, nn.Conv2d):
    """``nn.Conv2d`` on its active connections, whose dense weight is ``(out, in, height, width)``.

    ``structure`` has the shape ``(out, in * height * width)``: a flat index is that of the weight.
    """

    dense_class = nn.Conv2d
    weight: nn.Parameter
    _alone: tuple[Any, ImageChain] | None = None
    """Its attributes, and the chain that computes it where it is called by itself."""

    @classmethod
    def takes(cls, module: nn.Module) -> bool:
        """Whether a module is a convolution without groups, dilation and padding but by zeros."""
        return type(module) is nn.Conv2d and _is_plain(module)

    @property
    def dense_shape(self) -> tuple[int, ...]:
        return self.out_channels, self.in_channels, *self.kernel_size

    @property
    def is_computed(self) -> bool:
        """Whether the kernels compute the layer as it is set now."""
        rows, *columns = self.dense_shape
        return _is_plain(self) and self.structure.shape == (rows, prod(columns))

    def forward(self, input: th.Tensor) -> th.Tensor:
        """Apply the layer, as ``nn.Conv2d`` does.

        :raises UnsupportedError: if it has been set to what the kernels do not compute
        """
        attributes, alone = convolution_attributes(self), self._alone
        if alone is None or alone[0] != attributes:
            alone = self._alone = deepcopy(attributes), self._chain()
        return alone[1](input)

    def to_dense(self) -> None:
        vars(self).pop("_alone", None)
        super().to_dense()

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_alone": None}

    def _chain(self) -> ImageChain:
        """Make a chain of this layer alone."""
        if not self.is_computed:
            raise UnsupportedError(
                "a convolution in sparse storage has no groups and no dilation, is padded by zeros "
                "and keeps the shape of its weight, got "
                f"groups={self.groups}, dilation={self.dilation}, padding={self.padding!r}, "
                f"padding_mode={self.padding_mode!r} and the shape {self.dense_shape}; "
                "use compute='masked' for anything else"
            )
        step = ImageStep(Window.of(self), self.dense_shape, None, 0, 0, 1)
        return ImageChain([step], [self])
