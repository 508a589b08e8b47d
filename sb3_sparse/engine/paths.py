"""Feed-forward networks as sequences of linear layers and activations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from torch import nn

from sb3_sparse.engine.activations import ACTIVATIONS
from sb3_sparse.engine.linear import SparseLinear

Paths = Sequence[Sequence[nn.Module]]
"""The modules of each network, in the order of computation."""
OWN = ("torch.nn.", "sb3_sparse.engine.")
"""Modules that define a plain ``Sequential``; a user's subclass may do more than call its parts."""


def parts_of(path: Iterable[nn.Module]) -> list[tuple[nn.Linear, nn.Module | None]] | None:
    """Split a path into layers, each with its activation; None if it has any other module."""
    parts: list[tuple[nn.Linear, nn.Module | None]] = []
    for module in _leaves(path):
        if type(module) in (nn.Linear, SparseLinear):
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
    """Find every module on the paths, once."""
    found = (inner for path in paths for module in path for inner in module.modules())
    return list({id(module): module for module in found}.values())
