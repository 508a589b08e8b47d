"""Residual blocks, which the kernels compute where their layers allow it."""

from __future__ import annotations

from typing import ClassVar

import torch as th
from torch import nn


class Residual(nn.Module):
    """Adds to its input what some layers make of it: ``x + layers(x)``.

    :param layers: modules, of which the last has as many outputs as the first has inputs
    """

    name: ClassVar[str] = "residual"
    """The attribute that holds the layers, a ``Sequential``; part of a state_dict's keys."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__()
        self.add_module(self.name, nn.Sequential(*layers))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Compute ``x + layers(x)``, of the shape of ``x``."""
        out: th.Tensor = x + self.get_submodule(self.name)(x)
        return out
