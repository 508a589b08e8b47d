"""Sparse storage: the active connections only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.gradients import GradientMask
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.moments import moments_of
from sb3_sparse.engine.sparse_gradients import SparseStorageGradient
from sb3_sparse.engine.storage import LayerStorage
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import UnsupportedError

SPARSE_TYPES = (SparseLinear, SparseConv2d)
"""The layers that store their active connections only."""


class SparseStorage(LayerStorage):
    """Keeps a layer as the values and indices of its active connections.

    :param layer: the layer in masked storage, which is released
    :param optimizers: optimizers whose moments of the weight follow
    """

    is_sparse = True
    module: SparseLinear | SparseConv2d
    targets: list[SparseLinear | SparseConv2d]

    def __init__(self, layer: MaskedStorage, optimizers: Sequence[th.optim.Optimizer] = ()) -> None:
        kind = _sparse_type(layer.module)
        assert kind is not None
        super().__init__(layer.name, layer.module, layer.shape)
        self.initial_nnz, self.final_nnz = layer.initial_nnz, layer.final_nnz
        self.nnz = layer.nnz
        structure = Structure.of_mask(layer.mask(), (self.shape[0], self.size // self.shape[0]))
        self._structure = structure
        """The structure that targets and moments fit; after a load the module has another."""
        layer.release()
        self.module = kind.convert(layer.module, structure, is_target=False)
        self.module.check_mask = self.check_mask
        self.targets = []
        self._hooks = [
            self.module.register_load_state_dict_post_hook(self._after_load)  # type: ignore[no-untyped-call]
        ]
        for target in layer.targets:
            self.targets.append(kind.convert(target, structure, is_target=True))
            hook = target.register_load_state_dict_post_hook(self._after_target_load)  # type: ignore[no-untyped-call]
            self._hooks.append(hook)
        self.settle_moments(optimizers)

    def mask(self) -> NDArray[np.bool_]:
        return self.module.structure.mask()

    def dense(self) -> NDArray[np.float32]:
        array: NDArray[np.float32] = self.module.dense().numpy().ravel()
        return array

    def mask_targets(self) -> None:
        for target in self.targets:
            target.take(self.module.structure, target.dense())

    def remask(self) -> None:
        """Do nothing: inactive weights are not stored."""

    def mask_gradient(self) -> None:
        """Do nothing: inactive weights have no gradient."""

    def write(self, dense: th.Tensor) -> None:
        self.module.take(self.module.structure, dense)

    def settle_targets(self, soft: bool) -> None:
        if any(target.snapshot is not None for target in self.targets):  # else they fit
            super().settle_targets(soft)

    def _dense_targets(self) -> Iterable[NDArray[np.float32]]:
        return (target.dense().numpy() for target in self.targets)

    def _gradient_mask(self, functional: bool, capturing: Callable[[], bool]) -> GradientMask:
        return SparseStorageGradient(self, functional, capturing)

    def settle_moments(self, optimizers: Sequence[th.optim.Optimizer]) -> None:
        structure = self.module.structure
        places = None if structure is self._structure else _carried(structure, self._structure)
        for state, key, value in moments_of(optimizers, self.weight):
            if tuple(value.shape) == self.shape:
                state[key] = value.reshape(-1)[self._flat()]
            elif places is not None:
                state[key] = places(value)
        self._structure = structure
        self.moments_stale = False

    def clear_moments(
        self, where: NDArray[np.bool_], optimizers: Sequence[th.optim.Optimizer]
    ) -> None:
        if self.moments_stale:
            self.settle_moments(optimizers)
        places = th.from_numpy(where[self._structure.flat])
        for _, _, value in moments_of(optimizers, self.weight):
            if value.shape == places.shape:
                value.masked_fill_(places, 0.0)

    @property
    def connections(self) -> object:
        return self.module.structure

    def follow(self, optimizer: th.optim.Optimizer, since: object) -> None:
        structure = self.module.structure
        for state, key, value in moments_of([optimizer], self.weight):
            if tuple(value.shape) == self.shape:
                state[key] = value.reshape(-1)[self._flat()]
            elif since is structure:
                return
            elif isinstance(since, Structure) and value.shape == (since.nnz,):
                state[key] = _carried(structure, since)(value)
            else:
                raise UnsupportedError(
                    f"the connections of {self.name} have moved, and {type(optimizer).__name__} "
                    f"remembers {key!r} of shape {tuple(value.shape)}, which cannot follow them; "
                    "make a new optimizer after the mask has moved, or the policy with "
                    "compute='masked'"
                )

    def saved_moment(self, moment: th.Tensor) -> th.Tensor:
        if moment.shape != (self._structure.nnz,):
            return moment
        dense = moment.new_zeros(self.size)
        dense[th.from_numpy(self._structure.flat)] = moment
        return dense.view(self.shape)

    def to_masked(self, optimizers: Sequence[th.optim.Optimizer]) -> MaskedStorage:
        """Move the layer to masked storage; this object must not be used afterwards.

        :param optimizers: optimizers whose moments of the weight follow
        """
        mask = self.mask()
        for state, key, value in moments_of(optimizers, self.weight):
            state[key] = self.saved_moment(value)
        for hook in self._hooks:
            hook.remove()
        targets = [target.dense() for target in self.targets]
        for module in (self.module, *self.targets):
            module.to_dense()
        layer = MaskedStorage(self.name, self.module)
        layer.initial_nnz, layer.final_nnz = self.initial_nnz, self.final_nnz
        layer.set_mask(mask)
        layer.moments_stale = self.moments_stale
        for target, dense in zip(self.targets, targets, strict=True):
            layer.add_target(target)
            with th.no_grad():
                target.weight.copy_(dense)
        return layer

    def _flat(self) -> th.Tensor:
        return th.from_numpy(self.module.structure.flat)

    def _move(
        self,
        mask: NDArray[np.bool_],
        optimizers: Sequence[th.optim.Optimizer],
        soft_targets: bool,
        dense_grad: th.Tensor | None,
    ) -> None:
        if self.moments_stale:
            self.settle_moments(optimizers)
        before = self.module.structure
        after = Structure.of_mask(mask, before.shape)
        carried = _carried(after, before)
        grad = self.weight.grad
        if grad is not None:
            grad = _followed(grad, dense_grad, before, after, carried)
        for target in self.targets:
            if soft_targets:
                target.take(after, target.dense())
            else:
                target.await_copy(after)
        self.module.restructure(after, carried(self.weight.detach()))
        self.weight.grad = grad
        for state, key, value in moments_of(optimizers, self.weight):
            if value.shape == (before.nnz,):
                state[key] = carried(value)
        self._structure = after
        self.nnz = after.nnz

    def _after_load(self, module: nn.Module, incompatible_keys: object) -> None:
        structure = self.module.structure
        self.nnz = structure.nnz
        self.moments_stale = True
        if any(target.structure is not structure for target in self.targets):
            self.mask_targets()


def _carried(after: Structure, before: Structure) -> Callable[[th.Tensor], th.Tensor]:
    """Make a function that carries values from one structure to another; new ones are 0."""
    places = th.from_numpy(after.places_in(before))
    kept = places >= 0
    places.clamp_(min=0)

    def carry(values: th.Tensor) -> th.Tensor:
        return th.where(kept, values[places], 0.0)

    return carry


def _followed(
    grad: th.Tensor,
    dense_grad: th.Tensor | None,
    before: Structure,
    after: Structure,
    carried: Callable[[th.Tensor], th.Tensor],
) -> th.Tensor:
    """As :func:`~sb3_sparse.engine.masked_gradients.follow_mask`, on values."""
    moved = carried(grad)
    if dense_grad is None:
        return moved
    flat = dense_grad.reshape(-1)
    active = flat[th.from_numpy(before.flat)]
    square = th.dot(active, active)
    scale = th.where(square > 0, th.dot(grad, active) / square, 1.0)
    grown = th.from_numpy(after.places_in(before)) < 0
    return th.where(grown, scale * flat[th.from_numpy(after.flat)], moved)


def _sparse_type(module: nn.Module) -> type[SparseLinear] | type[SparseConv2d] | None:
    """The class that a layer becomes in sparse storage; None: it can only be masked."""
    return next((kind for kind in SPARSE_TYPES if kind.takes(module)), None)


def storable(module: nn.Module) -> bool:
    """Whether a dense layer can have sparse storage: a linear one, or a plain convolution."""
    return _sparse_type(module) is not None


def to_sparse(layer: LayerStorage, optimizers: Sequence[th.optim.Optimizer]) -> LayerStorage:
    """Move a layer to sparse storage, if it can have it; return others unchanged."""
    if isinstance(layer, MaskedStorage) and storable(layer.module):
        return SparseStorage(layer, optimizers)
    return layer
