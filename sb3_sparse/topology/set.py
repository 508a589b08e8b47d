"""SET: sparse evolutionary training."""

from __future__ import annotations

from sb3_sparse.sparsity.randomness import random_bits
from sb3_sparse.sparsity.selection import Indices
from sb3_sparse.topology.base import Array, DropGrow, Layer, MaskUpdate
from sb3_sparse.topology.registry import register


@register
class SET(DropGrow):
    """Grows connections uniformly at random.

    Source: arXiv:1707.04780, with the cosine decay of arXiv:1907.04840 as in arXiv:2206.10369.
    """

    name = "set"

    def scores(
        self, layer: Layer, update: MaskUpdate, candidates: Indices, *, dense_grad: Array | None
    ) -> Array:
        return random_bits(update.seed, f"{layer.name}/grow", candidates.size, update.step)
