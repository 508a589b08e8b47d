"""Chooses how a program reads each weight: by its connections or as a matrix."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_sparse.engine.auto import sparse_enough
from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.native.library import readable
from sb3_sparse.engine.storage import LayerStorage
from sb3_sparse.engine.structure import Structure
from sb3_sparse.fused.errors import NotCovered


class Stored(NamedTuple):
    """The present form of a weight.

    :param numbers: the tensor that the kernels read and optimizers move
    :param structure: connections; None: the weight is read as a matrix
    :param flat: position of each connection in ``numbers``, int32; None: consecutive
    :param mask: mask of a matrix, 0 where inactive; None: all weights count
    :param layer: storage of the weight; None for targets and dense layers
    """

    numbers: th.Tensor
    structure: Structure | None = None
    flat: th.Tensor | None = None
    mask: th.Tensor | None = None
    layer: LayerStorage | None = None

    @property
    def size(self) -> int:
        """Count of the numbers that an optimizer moves."""
        return self.numbers.numel() if self.structure is None else self.structure.nnz


class Storage:
    """Tracks the weights of a policy's linear layers.

    :param controller: controller of the policy
    :param modules: the linear layers of the program
    """

    def __init__(self, controller: Controller, modules: Iterable[nn.Linear]) -> None:
        layers = list(controller.layers)
        self._layers = {id(layer.module): layer for layer in layers}
        self._targets = {id(target): layer for layer in layers for target in layer.targets}
        linear = list(modules)
        self._sparse = [module for module in linear if isinstance(module, SparseLinear)]
        masked = [self._layers.get(id(module)) for module in linear]
        self._masked = [layer for layer in masked if isinstance(layer, MaskedStorage)]
        followers = [(module.weight, self._targets.get(id(module))) for module in linear]
        self._followers = [
            weight for weight, layer in followers
            if isinstance(layer, MaskedStorage) and not layer.always_full
        ]  # fmt: skip
        self._structures: dict[int, tuple[object, Structure, th.Tensor]] = {}
        self._own: dict[int, tuple[nn.Linear, np.ndarray]] = {}
        """Targets with connections of their own, and the mask of their weights that are not 0."""
        self._rewritten = 0

    def state(self) -> list[object]:
        """Return a list that changes whenever :meth:`of` would, apart from addresses."""
        for key, (module, written) in list(self._own.items()):
            if not np.array_equal(_written(module), written):  # by a copy that torch does not count
                del self._own[key]
                self._rewritten += 1
        return [
            self._rewritten,
            *(module.structure for module in self._sparse),
            *(module.snapshot for module in self._sparse if module.is_target),
            *(layer.connections for layer in self._masked),
            *(weight._version for weight in self._followers),
        ]

    def of(self, module: nn.Linear, follows: bool) -> Stored:
        """Describe the present form of a layer's weight.

        :param follows: whether it is a target that follows its layer at each step
        :raises NotCovered: if the kernels cannot read it
        """
        if isinstance(module, SparseLinear):
            structure, values = module.live()
            if follows and structure is not module.structure:
                raise NotCovered("a target with other connections than its layer")
            check_readable(values)
            layer = self._layers.get(id(module))
            full = structure.nnz == module.out_features * module.in_features
            return Stored(values, None if full else structure, layer=layer)
        weight = module.weight
        check_readable(weight)
        layer = self._layers.get(id(module)) or self._targets.get(id(module))
        if not isinstance(layer, MaskedStorage) or layer.full:
            return Stored(weight, layer=self._layers.get(id(module)))
        sparse = sparse_enough(layer.size, layer.nnz)
        if id(module) in self._layers:
            if not sparse:
                return Stored(weight, mask=layer.float_mask, layer=layer)
            structure, flat = self._structure(id(layer), layer.connections, layer.mask(), layer)
            return Stored(weight, structure, flat, layer=layer)
        if not sparse:
            return Stored(weight)
        written = _written(module)
        self._own.pop(id(module), None)
        structure, flat = self._structure(id(layer), layer.connections, layer.mask(), layer)
        if not (written & ~layer.mask()).any():
            return Stored(weight, structure, flat)
        if follows:
            raise NotCovered("a target with other connections than its layer")
        self._own[id(module)] = module, written
        structure, flat = self._structure(id(module), object(), written, layer)
        return Stored(weight, structure, flat)

    def _structure(
        self, key: int, connections: object, mask: np.ndarray, layer: LayerStorage
    ) -> tuple[Structure, th.Tensor]:
        kept = self._structures.get(key)
        if kept is None or kept[0] is not connections:
            structure = Structure.of_mask(mask, (layer.shape[0], layer.shape[1]))
            flat = th.from_numpy(structure.flat.astype(np.int32))
            kept = self._structures[key] = connections, structure, flat
        return kept[1:]


def _written(module: nn.Linear) -> np.ndarray:
    found: np.ndarray = module.weight.detach().numpy().ravel() != 0
    return found


def check_readable(tensor: th.Tensor) -> None:
    """Reject a tensor that the kernels cannot read in place.

    :raises NotCovered: unless it is contiguous float32 on the CPU
    """
    if not readable(tensor):
        raise NotCovered(f"a parameter of {tensor.dtype} on {tensor.device}")
