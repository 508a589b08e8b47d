"""Static sparse training: the mask never moves."""

from __future__ import annotations

from sb3_sparse.topology.base import NOTHING, Array, Exchange, Layer, MaskUpdate, TopologyMethod
from sb3_sparse.topology.registry import register


@register
class Static(TopologyMethod):
    """Keeps the initial random mask for the whole training.

    Source: arXiv:2206.10369, section 2.1.
    """

    name = "static"
    options = frozenset()

    def exchange(self, layer: Layer, update: MaskUpdate, *, dense_grad: Array | None) -> Exchange:
        return NOTHING
