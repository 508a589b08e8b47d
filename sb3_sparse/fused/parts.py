"""Networks as a program takes them: linear layers and what surrounds each."""

from __future__ import annotations

from torch import nn

from sb3_sparse.engine.activations import ACTIVATIONS
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.paths import parts_of
from sb3_sparse.engine.residual import Residual
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.program import Parts

KNOWN_MODULES = (nn.Linear, SparseLinear, nn.LayerNorm, nn.Identity, *ACTIVATIONS)


def parts(*modules: nn.Module) -> Parts:
    """Split a network into linear layers and what surrounds them, for ``program.network``.

    Each layer may have a LayerNorm before it and an activation behind it; residual blocks add the
    result of an earlier layer.

    Example::

        from torch import nn
        from sb3_sparse.fused import parts

        parts(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 1))  # two layers, one with an activation

    :raises NotCovered: if it has any other module
    """
    found = parts_of(modules)
    if found is None:
        leaves = [m for module in modules for m in module.modules() if not [*m.children()]]
        others = {type(m).__name__ for m in leaves if type(m) not in KNOWN_MODULES}
        if others:
            raise NotCovered(f"a network with {', '.join(sorted(others))}")
        order = ", ".join(type(m).__name__ for m in leaves)
        own = [
            type(m).__name__
            for module in modules
            for m in module.modules()
            if [*m.children()] and not isinstance(m, nn.Sequential) and type(m) is not Residual
            and type(m).forward is not Residual.forward
        ]  # fmt: skip
        raise NotCovered(
            f"a network with {own[0]}" if own else f"a network of {order} in this order"
        )
    return found
