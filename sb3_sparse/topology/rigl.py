"""RigL: the rigged lottery."""

from __future__ import annotations

import numpy as np

from sb3_sparse.sparsity.selection import Indices
from sb3_sparse.topology.base import Array, DropGrow, Layer, MaskUpdate
from sb3_sparse.topology.registry import register


@register
class RigL(DropGrow):
    """Grows the connections with the largest dense gradient; otherwise as SET.

    Source: arXiv:1911.11134, section 3.
    """

    name = "rigl"
    needs_gradient = True

    def scores(
        self, layer: Layer, update: MaskUpdate, candidates: Indices, *, dense_grad: Array | None
    ) -> Array:
        assert dense_grad is not None
        return np.abs(dense_grad[candidates])
