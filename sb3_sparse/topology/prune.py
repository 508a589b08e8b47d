"""Gradual magnitude pruning."""

from __future__ import annotations

import numpy as np

from sb3_sparse.sparsity.schedules import pruned_count
from sb3_sparse.sparsity.selection import least_magnitude
from sb3_sparse.topology.base import NOTHING, Array, Exchange, Layer, MaskUpdate, TopologyMethod
from sb3_sparse.topology.registry import register


@register
class Prune(TopologyMethod):
    """Removes the connections of least magnitude along a cubic ramp, for good.

    The policy must start denser than it ends (``initial_sparsity``, usually 0.0).

    Source: arXiv:1710.01878.
    """

    name = "prune"
    default_begin = 0.2
    reaches_final = True

    def exchange(self, layer: Layer, update: MaskUpdate, *, dense_grad: Array | None) -> Exchange:
        surplus = layer.nnz - allowed(layer, update)
        if surplus <= 0:
            return NOTHING
        active = np.flatnonzero(layer.mask())
        dropped = least_magnitude(layer.dense(), active, surplus)
        return Exchange(dropped=dropped, grown=np.empty(0, dtype=np.int64))


def allowed(layer: Layer, update: MaskUpdate) -> int:
    """Return how many connections the cubic ramp allows a layer at an update."""
    return pruned_count(
        layer.size,
        layer.initial_nnz,
        layer.final_nnz,
        update.progress,
        update.begin,
        update.end,
    )
