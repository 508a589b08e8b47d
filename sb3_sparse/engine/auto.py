"""The rule of ``compute="auto"``: which layers get sparse storage.

The rule goes by shapes, counts and the kernels' instruction set, so equal seeds give equal runs on
a machine. A chain of layers is one decision, because changing between two layouts of the batch
costs most where it happens. Linear layers with nothing but activations between them are a chain; it
becomes sparse if one of its layers is large and sparse enough. Convolutions with activations,
poolings and residual sums between them are one, too; it becomes sparse if all of its layers
together are sparse enough (docs/compute.md has the measurements).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence

import torch as th
from torch import nn

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.image_modules import in_order, is_between
from sb3_sparse.engine.native.library import in_use, why_missing
from sb3_sparse.engine.optimizers import acts_elementwise
from sb3_sparse.engine.paths import is_sequence
from sb3_sparse.engine.sequential import ELEMENTWISE
from sb3_sparse.engine.storage import LayerStorage
from sb3_sparse.errors import warn

LARGE = 2**13
"""Size of a layer below which overhead dominates."""
HUGE = 2**18
"""Size of a layer above which dense products are at their best."""
WITH_VECTORS = ("avx512", "avx2")
"""Instruction sets whose kernels compete with dense products at up to half the connections."""


class AutoCompute:
    """Applies the rule when a policy is built, and again after pruning has removed connections.

    :param allowed: names of the layers that may get sparse storage
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
        """Choose the layers to store as sparse; none if no connection was removed since.

        :param root: the policy
        :param layers: its layers within the budget
        :param optimizers: the optimizers that own them
        :return: names
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
        missing = why_missing()
        if missing is not None and any(layer.nnz < layer.size for layer in layers):
            warn(
                f"there are no kernels: {missing}. Training and acting take several times "
                "as long. Reinstall sb3-sparse where there is a C compiler (gcc or clang), or set "
                "compute='masked' to train so without this warning"
            )
        return choose(root, layers, self.allowed)


def choose(root: nn.Module, layers: Iterable[LayerStorage], allowed: Container[str]) -> list[str]:
    """Choose the layers to store as sparse.

    :param root: the policy
    :param layers: its layers within the budget
    :param allowed: names of the layers that may get sparse storage
    :return: names
    """
    if why_missing() is not None:
        return []
    layers = [layer for layer in layers if layer.name in allowed]
    linear = [
        chain
        for chain in chains_of(root, layers)
        if any(enough_for_chain(layer.size, layer.nnz) for layer in chain)
    ]
    images = [chain for chain in image_chains_of(root, layers) if enough_for_images(chain)]
    return [layer.name for chain in linear + images for layer in chain]


def enough_for_chain(size: int, nnz: int) -> bool:
    """Whether one layer gains enough for its whole chain to become sparse.

    :param size: connections of the dense layer
    :param nnz: active connections
    """
    return size >= LARGE and sparse_enough(size, nnz)


def enough_for_images(chain: Sequence[LayerStorage]) -> bool:
    """Whether convolutions gain by computing with their active connections only."""
    share = 2 if in_use() in WITH_VECTORS else 4
    return share * sum(layer.nnz for layer in chain) <= sum(layer.size for layer in chain)


def sparse_enough(size: int, nnz: int) -> bool:
    """Whether products with the active connections of a layer are faster than dense ones.

    :param size: connections of the dense layer
    :param nnz: active connections
    """
    if in_use() not in WITH_VECTORS:
        return nnz <= size / 4
    return nnz <= (size / 2 if size <= HUGE else size * 2 / 5)


def chains_of(root: nn.Module, layers: Iterable[LayerStorage]) -> list[list[LayerStorage]]:
    """Group linear layers that follow each other with nothing but activations between them."""
    linear = {id(layer.module): layer for layer in layers if isinstance(layer.module, nn.Linear)}
    sequences = (module for module in root.modules() if isinstance(module, nn.Sequential))
    return _grouped(linear, sequences, lambda module: type(module) in ELEMENTWISE)


def image_chains_of(root: nn.Module, layers: Iterable[LayerStorage]) -> list[list[LayerStorage]]:
    """Group convolutions that follow each other with nothing between them but what kernels compute.

    Convolutions that the kernels do not compute are left out.
    """
    convolutions = {
        id(layer.module): layer
        for layer in layers
        if SparseConv2d.takes(layer.module) or isinstance(layer.module, SparseConv2d)
    }
    return _grouped(convolutions, map(in_order, filter(is_sequence, root.modules())), is_between)


def _grouped(
    layers: Mapping[int, LayerStorage],
    sequences: Iterable[Iterable[nn.Module]],
    is_between: Callable[[nn.Module], bool],
) -> list[list[LayerStorage]]:
    """Group layers that follow each other.

    :param layers: by the id of their module
    :param sequences: modules in the order in which they are called
    :param is_between: whether a module may stand between two layers of a chain
    """
    chains: list[list[LayerStorage]] = []
    left = dict(layers)
    for sequence in sequences:
        chain: list[LayerStorage] = []
        for module in sequence:
            layer = left.pop(id(module), None)
            if layer is not None:
                chain.append(layer)
            elif not is_between(module) and chain:
                chains.append(chain)
                chain = []
        if chain:
            chains.append(chain)
    return chains + [[layer] for layer in left.values()]
