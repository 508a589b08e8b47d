"""Networks as a program takes them: linear layers, each with its activation."""

from __future__ import annotations

from torch import nn

from sb3_sparse.engine.activations import ACTIVATIONS
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.paths import parts_of
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.program import Parts

KNOWN_MODULES = (nn.Linear, SparseLinear, nn.LayerNorm, nn.Identity, *ACTIVATIONS)


def parts(*modules: nn.Module) -> Parts:
    """Split a network into linear layers and activations, for ``program.network``.

    Example::

        from torch import nn
        from sb3_sparse.fused import parts

        parts(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 1))  # two layers, one with an activation

    :raises NotCovered: if it has any other module
    """
    found = parts_of(modules)
    if found is None:
        inner = (m for module in modules for m in module.modules() if not list(m.children()))
        others = {type(m).__name__ for m in inner if type(m) not in KNOWN_MODULES}
        raise NotCovered(f"a network with {', '.join(sorted(others)) or 'modules of its own'}")
    return found
