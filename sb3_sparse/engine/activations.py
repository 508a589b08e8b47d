"""Activations that the kernels compute."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import nn

Activation = Callable[[Any], tuple[int, float, float]]
ACTIVATIONS: dict[type[nn.Module], Activation] = {
    nn.ReLU: lambda _: (1, 0.0, 0.0),
    nn.Tanh: lambda _: (2, 0.0, 0.0),
    nn.Sigmoid: lambda _: (3, 0.0, 0.0),
    nn.ELU: lambda m: (4, m.alpha, 0.0),
    nn.CELU: lambda m: (5, m.alpha, 0.0),
    nn.SELU: lambda _: (6, 0.0, 0.0),
    nn.GELU: lambda m: (7 if m.approximate == "none" else 8, 0.0, 0.0),
    nn.SiLU: lambda _: (9, 0.0, 0.0),
    nn.Mish: lambda _: (10, 0.0, 0.0),
    nn.Softplus: lambda m: (11, m.beta, m.threshold),
    nn.LeakyReLU: lambda m: (12, m.negative_slope, 0.0),
    nn.ReLU6: lambda m: (13, m.min_val, m.max_val),
    nn.Hardtanh: lambda m: (13, m.min_val, m.max_val),
    nn.Hardswish: lambda _: (14, 0.0, 0.0),
}
"""Gives the number and the parameters of an activation in ``kernels.h``."""

ADJUSTABLE = (nn.ELU, nn.CELU, nn.GELU, nn.Softplus, nn.LeakyReLU, nn.Hardtanh)
"""Activations with numbers as attributes, which the user may change."""
_WITH_SLOPE: dict[type[nn.Module], Callable[[Any], bool]] = {
    nn.ReLU: lambda _: True,
    nn.Tanh: lambda _: True,
    nn.Sigmoid: lambda _: True,
    nn.ELU: lambda m: m.alpha >= 0,
    nn.CELU: lambda m: m.alpha > 0,
    nn.SELU: lambda _: True,
    nn.LeakyReLU: lambda m: m.negative_slope >= 0,
    nn.ReLU6: lambda _: True,
    nn.Hardtanh: lambda _: True,
}


def tells_its_slope(module: nn.Module) -> bool:
    """Whether the slope follows from the result alone, as the kernels' backward pass needs it."""
    tells = _WITH_SLOPE.get(type(module))
    return tells is not None and tells(module)


def number_of(module: nn.Module | None) -> tuple[int, float, float]:
    """Return number and parameters of an activation in ``kernels.h``; None is the identity."""
    return (0, 0.0, 0.0) if module is None else ACTIVATIONS[type(module)](module)
