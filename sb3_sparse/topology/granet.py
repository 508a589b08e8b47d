"""GraNet: gradual pruning that regrows some of what it drops."""

from __future__ import annotations

from sb3_sparse.sparsity.distributions import floor_count
from sb3_sparse.sparsity.schedules import cosine_drop_fraction
from sb3_sparse.topology.base import Layer, MaskUpdate
from sb3_sparse.topology.prune import allowed
from sb3_sparse.topology.registry import register
from sb3_sparse.topology.rigl import RigL


@register
class GraNet(RigL):
    """Prunes along the cubic ramp of ``prune``, and exchanges connections as RigL on the way.

    Each update leaves as many connections as the ramp allows, of which the drop fraction are
    chosen anew: those of least magnitude give way to those with the largest dense gradient. The
    policy must start denser than it ends (``initial_sparsity``, usually half the sparsity).

    Source: arXiv:2106.10404, section 3.3.
    """

    name = "granet"
    reaches_final = True
    initial_share = 0.5

    def counts(self, layer: Layer, update: MaskUpdate) -> tuple[int, int]:
        # A training that goes on, at a lower progress, brings nothing back.
        keep = min(allowed(layer, update), layer.nnz)
        fraction = cosine_drop_fraction(update.progress, update.drop_fraction, update.end)
        grown = floor_count(fraction * keep)
        return layer.nnz - keep + grown, grown
