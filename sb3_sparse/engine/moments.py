"""What an optimizer remembers of single weights."""

from __future__ import annotations

import torch as th
from torch import nn


def keep_only(optimizer: th.optim.Optimizer, weight: nn.Parameter, kept: th.Tensor) -> None:
    """Zero an optimizer's moments of ``weight`` wherever ``kept`` is 0.

    Every state tensor of the weight's shape is a moment (Adam's two, RMSprop's, a momentum buffer).

    :param kept: 1.0 or 0.0, in the weight's shape
    """
    for value in optimizer.state.get(weight, {}).values():
        if isinstance(value, th.Tensor) and value.shape == weight.shape:
            value.mul_(kept)
