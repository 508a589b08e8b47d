"""Support for the user's own optimizers on a policy's weights, e.g. for behaviour cloning.

Their steps do not advance the policy's clocks. But their moments of a weight must follow its mask,
and what they write to inactive connections must be removed. Torch's hooks on the steps of all
optimizers do this, for the weights of sparse layers alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import count
from typing import Any, NamedTuple, Protocol
from weakref import WeakKeyDictionary, WeakSet, ref

import torch as th
from torch.optim.optimizer import (
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)

from sb3_sparse.engine.optimizers import acts_elementwise
from sb3_sparse.engine.storage import LayerStorage
from sb3_sparse.errors import UnsupportedError


class Owner(Protocol):
    """Has sparse layers, and optimizers of its own."""

    @property
    def layers(self) -> Iterable[LayerStorage]:
        """Every layer within a budget, once."""

    @property
    def optimizers(self) -> list[th.optim.Optimizer]:
        """Every optimizer that owns a network, once."""


class _Found(NamedTuple):
    """The sparse layers that an optimizer moves, and the facts that this was derived from."""

    changes: int
    parameters: int  # hash of their ids
    layers: list[ref[LayerStorage]]

    def alive(self) -> Iterator[LayerStorage]:
        return (layer for reference in self.layers if (layer := reference()) is not None)


_owners: WeakSet[Any] = WeakSet()
_found: WeakKeyDictionary[th.optim.Optimizer, _Found] = WeakKeyDictionary()
_followed: WeakKeyDictionary[th.optim.Optimizer, WeakKeyDictionary[LayerStorage, object]]
_followed = WeakKeyDictionary()
"""The connections that each optimizer's moments fit, by layer."""
_count: Callable[[], int] = count(1).__next__
_changes = 0


def watch(owner: Owner) -> None:
    """Follow every optimizer that moves layers of ``owner``, which is held weakly.

    Call it again when the owner's layers or optimizers have changed.
    """
    global _changes
    if all(layer.always_full for layer in owner.layers):
        return  # no weight is ever inactive
    if not _changes:
        register_optimizer_step_pre_hook(_before_step)
        register_optimizer_step_post_hook(_after_step)
    _changes = _count()
    _owners.add(owner)


def _before_step(optimizer: th.optim.Optimizer, args: object, kwargs: object) -> None:
    for layer in _layers_of(optimizer):
        followed = _followed.setdefault(optimizer, WeakKeyDictionary())
        since = followed.get(layer, layer.connections)
        if layer.is_sparse and since is not layer.connections and not acts_elementwise(optimizer):
            raise UnsupportedError(
                f"the connections of {layer.name} have moved, and {type(optimizer).__name__} does "
                "not move each weight by itself, so its moments cannot follow them; make a "
                "new optimizer after the mask has moved, or the policy with compute='masked'"
            )
        layer.follow(optimizer, since)
        followed[layer] = layer.connections


def _after_step(optimizer: th.optim.Optimizer, args: object, kwargs: object) -> None:
    found = _found.get(optimizer)
    for layer in () if found is None else found.alive():
        layer.remask()


def _layers_of(optimizer: th.optim.Optimizer) -> Iterator[LayerStorage]:
    moved = tuple([id(p) for group in optimizer.param_groups for p in group["params"]])
    parameters = hash(moved)
    found = _found.get(optimizer)
    if found is None or found.changes != _changes or found.parameters != parameters:
        layers = [
            ref(layer)
            for owner in _owners
            if not any(optimizer is own for own in owner.optimizers)
            for layer in owner.layers
            if id(layer.module._parameters.get("weight")) in moved  # may be parametrized by now
        ]
        found = _found[optimizer] = _Found(_changes, parameters, layers)
    return found.alive()


class Guard:
    """Keeps the masks of a network outside its policy, such as a copy of an actor.

    It masks gradients on arrival and follows optimizers as :func:`watch` does.

    :param layers: the sparse layers of the copy
    """

    optimizers: list[th.optim.Optimizer] = []
    """It has none of its own."""

    def __init__(self, layers: Iterable[LayerStorage]) -> None:
        self.layers = list(layers)
        for layer in self.layers:
            if not layer.is_sparse and not layer.frozen:
                hook: Any = partial(_mask_gradient, ref(layer))
                layer.weight.register_post_accumulate_grad_hook(hook)  # type: ignore[no-untyped-call]
        watch(self)


def _mask_gradient(reference: ref[LayerStorage], weight: th.Tensor) -> None:
    if (layer := reference()) is not None:
        layer.mask_gradient()
