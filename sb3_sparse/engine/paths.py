"""Feed-forward networks as what the kernels know of them: linear layers and activations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from torch import nn

from sb3_sparse.engine.linear import CompactLinear

Activation = Callable[[Any], tuple[int, float, float]]
Paths = Sequence[Sequence[nn.Module]]
"""Modules of each network in the order of computation."""
OWN = ("torch.nn.", "sb3_sparse.engine.")
"""Where a ``Sequential`` that calls its parts in turn is defined; one of the user's may do more."""
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
    nn.ReLU6: lambda _: (13, 0.0, 6.0),
    nn.Hardtanh: lambda m: (13, m.min_val, m.max_val),
    nn.Hardswish: lambda _: (14, 0.0, 0.0),
}
"""Number and parameters of an activation in ``kernels.h``."""


def parts_of(path: Iterable[nn.Module]) -> list[tuple[nn.Linear, nn.Module | None]] | None:
    """Layers, each with its activation; None if there is anything else."""
    parts: list[tuple[nn.Linear, nn.Module | None]] = []
    for module in _leaves(path):
        if type(module) in (nn.Linear, CompactLinear):
            assert isinstance(module, nn.Linear)
            parts.append((module, None))
        elif type(module) in ACTIVATIONS and parts and parts[-1][1] is None:
            parts[-1] = (parts[-1][0], module)
        elif type(module) is not nn.Identity:
            return None
    return parts


def _leaves(path: Iterable[nn.Module]) -> Iterable[nn.Module]:
    for module in path:
        if isinstance(module, nn.Sequential) and type(module).__module__.startswith(OWN):
            yield from _leaves(module)
        else:
            yield module


def modules_of(paths: Paths) -> list[nn.Module]:
    """Every module on the paths, once."""
    found = (inner for path in paths for module in path for inner in module.modules())
    return list({id(module): module for module in found}.values())
