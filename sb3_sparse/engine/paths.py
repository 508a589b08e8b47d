"""Feed-forward networks as sequences of linear layers and activations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from torch import nn

from sb3_sparse.engine.activations import ACTIVATIONS
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.norms import NORMS, features_of
from sb3_sparse.engine.residual import Residual

Paths = Sequence[Sequence[nn.Module]]
"""The modules of each network, in the order of computation."""
OWN = ("torch.nn.", "sb3_sparse.engine.")
"""Modules that define a plain ``Sequential``."""


class Part(NamedTuple):
    """A linear layer and what surrounds it: ``activation(layer(norm(x))) + shortcut``.

    :param layer: None for a norm at the end of a path, which has no layer behind it
    :param activation: None: no activation
    :param norm: norm of the layer's input, of a type in ``NORMS``; None: there is none
    :param shortcut: number of the part whose result is added, -1 for the input of the path; None:
        nothing is added
    """

    layer: nn.Linear | None
    activation: nn.Module | None = None
    norm: nn.Module | None = None
    shortcut: int | None = None


def is_sequence(module: nn.Module) -> bool:
    """Whether a module calls its parts in turn; a user's ``Sequential`` may do more."""
    return isinstance(module, nn.Sequential) and type(module).__module__.startswith(OWN)


def is_residual(module: nn.Module) -> bool:
    """Whether a module adds to its input what its parts make of it, and has no others."""
    return (
        isinstance(module, Residual)
        and type(module).forward is Residual.forward
        and list(module._modules) == [module.name]
    )


def called_by(module: nn.Module) -> list[nn.Module]:
    """Return what a sequence or a residual block calls, in that order, also twice."""
    return [child for child in module._modules.values() if child is not None]


def parts_of(path: Iterable[nn.Module]) -> list[Part] | None:
    """Split a path into layers and what surrounds them; None if it has any other module."""
    parts: list[Part] = []
    if not _split(path, parts):
        return None
    return parts


def _split(path: Iterable[nn.Module], parts: list[Part]) -> bool:
    """Append the parts of a path; False if it has a module that no part can hold."""
    for module in path:
        last = parts[-1] if parts else None
        behind_norm = last is not None and last.layer is None
        if is_sequence(module):
            if not _split(called_by(module), parts):
                return False
        elif is_residual(module):
            if behind_norm or not _split_residual(module, parts):
                return False
        elif type(module) in (nn.Linear, SparseLinear):
            assert isinstance(module, nn.Linear)
            norm = parts.pop().norm if behind_norm else None
            parts.append(Part(module, norm=norm))
        elif type(module) in NORMS:
            if behind_norm or len(features_of(module)) != 1:
                return False
            parts.append(Part(None, norm=module))
        elif type(module) in ACTIVATIONS:
            if last is None or last[1:] != (None, last.norm, None) or behind_norm:
                return False
            parts[-1] = last._replace(activation=module)
        elif type(module) is not nn.Identity:
            return False
    return True


def _split_residual(module: nn.Module, parts: list[Part]) -> bool:
    before = len(parts)
    inner: list[Part] = []  # of its own, so that no activation belongs to a layer before the block
    if not _split(called_by(module), inner):
        return False
    if not inner or inner[-1].layer is None or inner[-1].shortcut is not None:
        return False
    shifted = [
        part if part.shortcut is None else part._replace(shortcut=part.shortcut + before)
        for part in inner
    ]
    parts += [*shifted[:-1], shifted[-1]._replace(shortcut=before - 1)]
    return True


def modules_of(paths: Paths) -> list[nn.Module]:
    """Find every module on the paths, once."""
    found = (inner for path in paths for module in path for inner in module.modules())
    return list({id(module): module for module in found}.values())
