"""Which linear layers store and compute their active connections only: ``compute="auto"``.

The rule goes by shapes, counts and the kernels' instruction set, so equal seeds give equal runs on
a machine. A chain of layers with nothing but activations between them is one decision, because
changing between rows and tiles costs most where it happens. The whole chain becomes sparse if one
of its layers is large and sparse enough (docs/compute.md has the measurements).
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence

import torch as th
from torch import nn

from sb3_sparse.engine.native.library import in_use, why_missing
from sb3_sparse.engine.optimizers import acts_elementwise
from sb3_sparse.engine.sequential import ELEMENTWISE
from sb3_sparse.engine.storage import LayerStorage

LARGE = 2**13
"""Connections of a dense layer below which overhead decides."""
HUGE = 2**18
"""Connections of a dense layer beyond which dense products are at their best."""
WITH_VECTORS = ("avx512", "avx2")
"""Instruction sets whose kernels keep up with dense products of some density."""


class AutoCompute:
    """Applies the rule when a policy is built, and again after pruning has removed connections.

    :param allowed: names of the layers that may be stored as their active connections only
    """

    def __init__(self, allowed: Container[str]) -> None:
        self.allowed = allowed
        self._nnz = -1

    def choose(
        self,
        root: nn.Module,
        layers: Sequence[LayerStorage],
        optimizers: Iterable[th.optim.Optimizer],
    ) -> list[str]:
        """Names of the layers to store as sparse; none if nothing has changed.

        :param root: the policy
        :param layers: its sparse layers
        :param optimizers: what moves them
        """
        nnz = sum(layer.nnz for layer in layers)
        if nnz == self._nnz:
            return []
        self._nnz = nnz
        here = all(
            layer.weight.device.type == "cpu" and layer.weight.dtype == th.float32
            for layer in layers
        )
        if not here or not all(acts_elementwise(optimizer) for optimizer in optimizers):
            return []
        return choose(root, layers, self.allowed)


def choose(root: nn.Module, layers: Iterable[LayerStorage], allowed: Container[str]) -> list[str]:
    """Names of the layers to store as sparse.

    :param root: the policy
    :param layers: its sparse layers
    :param allowed: names of those that may be stored so
    """
    if why_missing() is not None:
        return []
    return [
        layer.name
        for chain in chains_of(root, (layer for layer in layers if layer.name in allowed))
        if any(pays(layer.size, layer.nnz) for layer in chain)
        for layer in chain
    ]


def pays(size: int, nnz: int) -> bool:
    """Whether a layer gains so much from sparse storage that its chain should have it.

    :param size: connections of the dense layer
    :param nnz: active ones
    """
    return size >= LARGE and sparse_enough(size, nnz)


def sparse_enough(size: int, nnz: int) -> bool:
    """Whether products with the active connections of a layer are quicker than dense ones.

    :param size: connections of the dense layer
    :param nnz: active ones
    """
    if in_use() not in WITH_VECTORS:
        return nnz <= size / 4
    return nnz <= (size / 2 if size <= HUGE else size * 2 / 5)


def chains_of(root: nn.Module, layers: Iterable[LayerStorage]) -> list[list[LayerStorage]]:
    """Linear layers in groups that follow each other with nothing but activations between."""
    linear = {id(layer.module): layer for layer in layers if isinstance(layer.module, nn.Linear)}
    chains: list[list[LayerStorage]] = []
    seen: set[int] = set()
    for sequence in root.modules():
        if not isinstance(sequence, nn.Sequential):
            continue
        chain: list[LayerStorage] = []
        for module in sequence:
            layer = linear.get(id(module))
            if layer is not None and id(module) not in seen:
                seen.add(id(module))
                chain.append(layer)
            elif type(module) not in ELEMENTWISE and chain:
                chains.append(chain)
                chain = []
        if chain:
            chains.append(chain)
    return chains + [[layer] for key, layer in linear.items() if key not in seen]
