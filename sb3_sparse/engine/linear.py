"""A linear layer that stores and computes its active connections only."""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_sparse.engine.chains import Chain
from sb3_sparse.engine.layer import Snapshot, SparseLayer

__all__ = ["Snapshot", "SparseLinear"]  # pickles of earlier versions find a Snapshot here


class SparseLinear(SparseLayer, nn.Linear):
    """``nn.Linear`` on its active connections, whose dense weight is ``(out, in)``."""

    dense_class = nn.Linear
    weight: nn.Parameter

    def forward(self, input: th.Tensor) -> th.Tensor:
        """Apply the layer, as ``nn.Linear`` does."""
        return Chain([self], [None])(input)
