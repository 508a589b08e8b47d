"""Optimizers of the user's own that move a policy's weights: behaviour cloning, say.

Their steps are no business of a policy's clocks. But what they remember of a weight must follow its
mask, and what they write to inactive connections must go. Torch has hooks on the steps of all
optimizers for this; they look at nothing but the weights of sparse layers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import count
from typing import Any, NamedTuple, Protocol
from weakref import WeakKeyDictionary, WeakSet, ref

import torch as th
from torch.optim.optimizer import (
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)

from sb3_sparse.engine.layers import SparseLayer


class Owner(Protocol):
    """Has sparse layers, and optimizers that it looks after itself."""

    @property
    def layers(self) -> Iterable[SparseLayer]:
        """Every sparse layer once."""

    @property
    def optimizers(self) -> list[th.optim.Optimizer]:
        """Every optimizer that owns a network, once."""


class _Found(NamedTuple):
    """The sparse layers that an optimizer moves, and what that was worked out from."""

    changes: int
    parameters: int
    layers: list[ref[SparseLayer]]


_owners: WeakSet[Any] = WeakSet()
_found: WeakKeyDictionary[th.optim.Optimizer, _Found] = WeakKeyDictionary()
_followed: WeakKeyDictionary[th.optim.Optimizer, WeakKeyDictionary[SparseLayer, object]]
_followed = WeakKeyDictionary()
"""The connections that each optimizer's moments of each layer go by."""
_count: Callable[[], int] = count(1).__next__
_changes = 0


def watch(owner: Owner) -> None:
    """Look after the layers of ``owner`` from now on; it is held weakly.

    Call again when its layers or optimizers are others.
    """
    global _changes
    if not _changes:
        register_optimizer_step_pre_hook(_before_step)
        register_optimizer_step_post_hook(_after_step)
    _changes = _count()
    _owners.add(owner)


def _before_step(optimizer: th.optim.Optimizer, args: object, kwargs: object) -> None:
    for layer in _layers_of(optimizer):
        followed = _followed.setdefault(optimizer, WeakKeyDictionary())
        layer.follow(optimizer, followed.get(layer, layer.connections))
        followed[layer] = layer.connections


def _after_step(optimizer: th.optim.Optimizer, args: object, kwargs: object) -> None:
    for layer in _layers_of(optimizer):
        layer.remask()


def _layers_of(optimizer: th.optim.Optimizer) -> Iterator[SparseLayer]:
    parameters = sum(len(group["params"]) for group in optimizer.param_groups)
    found = _found.get(optimizer)
    if found is None or found.changes != _changes or found.parameters != parameters:
        moved = {id(p) for group in optimizer.param_groups for p in group["params"]}
        layers = [
            ref(layer)
            for owner in _owners
            if not any(optimizer is own for own in owner.optimizers)
            for layer in owner.layers
            if id(layer.module._parameters.get("weight")) in moved  # may be parametrized by now
        ]
        found = _found[optimizer] = _Found(_changes, parameters, layers)
    return (layer for reference in found.layers if (layer := reference()) is not None)
