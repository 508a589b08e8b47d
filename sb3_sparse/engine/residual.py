"""Residual blocks, which the kernels compute where their layers allow it."""

from __future__ import annotations

import torch as th
from torch import nn


class Residual(nn.Module):
    """Adds to its input what some layers make of it: ``x + residual(x)``.

    :param layers: modules, of which the last has as many outputs as the first has inputs
    """

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.residual = nn.Sequential(*layers)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Compute ``x + residual(x)``, of the shape of ``x``."""
        out: th.Tensor = x + self.residual(x)
        return out
