"""Networks as a program takes them: linear layers and what surrounds each."""

from __future__ import annotations

from collections.abc import Iterable

from torch import nn

from sb3_sparse.engine.activations import ACTIVATIONS
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.norms import NORMS
from sb3_sparse.engine.paths import is_residual, is_sequence, parts_of
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.program import Parts

KNOWN_MODULES = (nn.Linear, SparseLinear, nn.Identity, *ACTIVATIONS)


def parts(*modules: nn.Module) -> Parts:
    """Split a network into linear layers and what surrounds them, for ``program.network``.

    Each layer may have a LayerNorm or BatchRenorm before it and an activation behind it; residual
    blocks add the result of an earlier layer.

    Example::

        from torch import nn
        from sb3_sparse.fused import parts

        parts(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 1))  # two layers, one with an activation

    :raises NotCovered: if it has any other module
    """
    found = parts_of(modules)
    if found is None:
        raise NotCovered(f"a network {_obstacle(modules)}")
    return found


def _obstacle(modules: Iterable[nn.Module]) -> str:
    """Say what makes a network one that programs do not know."""
    inner = [m for module in modules for m in module.modules()]
    parts = [m for m in inner if not is_sequence(m) and not is_residual(m)]
    others = {type(m).__name__ for m in parts if type(m) not in (*KNOWN_MODULES, *NORMS)}
    if others:
        return f"with {', '.join(sorted(others))}"
    return f"of {', '.join(type(m).__name__ for m in parts)} in this order"
