"""Translates torch's activations to operations of a graph."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from torch import nn
from torch.nn import functional

from sb3_sparse.export.nodes import Activation, Affine, Clip, Node, Slopes

Make = Callable[[int, tuple[int, ...]], Node]
"""Makes a node, given its input value and the shape of that."""
SELU_ALPHA = 1.6732632423543772
SELU_SCALE = 1.0507009873554805
"""Torch's constants. Source: arXiv:1706.02515."""


def nodes_of(module: nn.Module) -> list[Make] | None:
    """Return what an elementwise module of torch does; None for any other module."""
    made = FORMULAS.get(type(module))
    return None if made is None else made(module)


def called(function: Any, arguments: list[Any], options: dict[str, Any]) -> nn.Module | None:
    """Return the module that does the same as a call of a function or of a tensor's method.

    :param function: the function, or the method's name
    :param arguments: positional arguments after the tensor
    :param options: keyword arguments
    :return: None if there is no such module
    """
    kind = FUNCTIONS.get(function)
    if kind is None:
        return None
    try:
        return kind(*arguments, **options)
    except TypeError:
        return None


def _each(kind: str, **parameters: float) -> list[Make]:
    return [lambda value, shape: Activation((value,), shape, kind, parameters)]


def scaled(factor: float, shift: float = 0.0) -> list[Make]:
    """Return ``x * factor + shift``, or nothing if that is ``x``."""

    def make(value: int, shape: tuple[int, ...]) -> Node:
        units = np.ones(shape[0], np.float32)
        return Affine((value,), shape, units * np.float32(factor), units * np.float32(shift))

    return [] if (factor, shift) == (1.0, 0.0) else [make]


def _clipped(low: float, high: float) -> list[Make]:
    def make(value: int, shape: tuple[int, ...]) -> Node:
        units = np.ones(shape[0], np.float32)
        return Clip((value,), shape, units * np.float32(low), units * np.float32(high))

    return [make]


def _sloped(module: nn.PReLU) -> list[Make]:
    slopes = module.weight.detach().cpu().numpy().astype(np.float32)
    if len(slopes) == 1:
        return _each("leaky_relu", slope=float(slopes[0]))
    return [lambda value, shape: Slopes((value,), shape, slopes)]


def _softplus(beta: float, threshold: float) -> list[Make]:
    """``log(1 + exp(beta x)) / beta``, and ``x`` where ``beta x`` is above the threshold."""
    return [*scaled(beta), *_each("softplus", threshold=threshold), *scaled(1.0 / beta)]


def _flatten(start_dim: int = 0, end_dim: int = -1) -> nn.Module:
    return nn.Flatten(start_dim, end_dim)


def _dropout(p: float = 0.5, training: bool = True) -> nn.Module:
    if training:  # the function's default, in evaluation too
        raise TypeError("random actions cannot be exported")
    return nn.Identity()


FORMULAS: dict[type[nn.Module], Callable[[Any], list[Make]]] = {
    nn.ReLU: lambda module: _each("relu"),
    nn.LeakyReLU: lambda module: _each("leaky_relu", slope=module.negative_slope),
    nn.PReLU: _sloped,
    nn.RReLU: lambda module: _each("leaky_relu", slope=(module.lower + module.upper) / 2.0),
    nn.ELU: lambda module: _each("elu", slope=module.alpha),
    nn.SELU: lambda module: [*_each("elu", slope=SELU_ALPHA), *scaled(SELU_SCALE)],
    nn.CELU: lambda module: [
        *scaled(1.0 / module.alpha),
        *_each("elu", slope=1.0),
        *scaled(module.alpha),
    ],
    nn.Tanh: lambda module: _each("tanh"),
    nn.Sigmoid: lambda module: _each("sigmoid"),
    nn.SiLU: lambda module: _each("silu"),
    nn.GELU: lambda module: _each("gelu" if module.approximate == "none" else "gelu_tanh"),
    nn.Mish: lambda module: _each("mish"),
    nn.Softplus: lambda module: _softplus(module.beta, module.threshold),
    nn.LogSigmoid: lambda module: [*scaled(-1.0), *_softplus(1.0, math.inf), *scaled(-1.0)],
    nn.Softsign: lambda module: _each("softsign"),
    nn.Hardswish: lambda module: _each("hardswish"),
    nn.Hardsigmoid: lambda module: [*scaled(1.0 / 6.0, 0.5), *_clipped(0.0, 1.0)],
    nn.Hardtanh: lambda module: _clipped(module.min_val, module.max_val),
    nn.ReLU6: lambda module: _clipped(0.0, 6.0),
    nn.Tanhshrink: lambda module: _each("tanhshrink"),
    nn.Softshrink: lambda module: _each("softshrink", most=module.lambd),
    nn.Hardshrink: lambda module: _each("hardshrink", most=module.lambd),
    nn.Threshold: lambda module: _each("threshold", most=module.threshold, instead=module.value),
    nn.Identity: lambda module: [],
}
FUNCTIONS: dict[Any, Callable[..., nn.Module]] = {
    **{
        getattr(functional, kind.__name__.lower()): kind
        for kind in FORMULAS
        if hasattr(functional, kind.__name__.lower()) and kind not in (nn.PReLU, nn.RReLU)
    },
    functional.leaky_relu: nn.LeakyReLU,
    **dict.fromkeys((th.relu, "relu"), nn.ReLU),
    **dict.fromkeys((th.tanh, "tanh"), nn.Tanh),
    **dict.fromkeys((th.sigmoid, "sigmoid"), nn.Sigmoid),
    **dict.fromkeys((th.clamp, th.clip, "clamp", "clip"), nn.Hardtanh),
    **dict.fromkeys((th.flatten, "flatten"), _flatten),
    functional.max_pool2d: nn.MaxPool2d,
    functional.dropout: _dropout,
    "float": nn.Identity,
}
"""The functions and methods that a ``forward`` may call, and the modules that do the same."""
NAMES = ", ".join(kind.__name__ for kind in FORMULAS)
