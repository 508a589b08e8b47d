"""A sparse layer whose connections one thread moves while others compute with it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_sparse.engine.sparse import SPARSE_TYPES
from sb3_sparse.engine.structure import Structure

MOVES, OUTPUTS = 10000, 20
"""How often connections move, and outputs are computed, at least."""


def largest_while_moving(
    shape: tuple[int, int],
    densities: tuple[float, float],
    actor_of: Callable[[nn.Module], Callable[[], th.Tensor]],
    threads: int,
    layer: nn.Module | None = None,
) -> tuple[list[Any], set[float]]:
    """The largest of many outputs for inputs of 1, and what they may be: each mask's own.

    Every weight is 0.5, so a mask that is read halfway gives another number, and an error of a
    thread stands among the outputs.

    :param actor_of: makes, of the layer, what the threads call
    :param layer: of as many inputs and outputs; None: a linear layer
    """
    random = np.random.default_rng(0)
    layer = nn.Linear(shape[1], shape[0]) if layer is None else layer
    masks = [random.random(shape) < density for density in densities]
    structures = [Structure.of_mask(mask, mask.shape) for mask in masks]
    (kind,) = (kind for kind in SPARSE_TYPES if kind.takes(layer))
    kind.convert(layer, structures[0], is_target=False)
    layer.bias.data.zero_()
    layer.restructure(structures[0], th.full((structures[0].nnz,), 0.5))
    act, found, done = actor_of(layer), [], threading.Event()

    def go_on() -> None:
        while not done.is_set():
            try:
                with th.no_grad():
                    found.append(float(act().max()))
            except Exception as error:
                found.append(error)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    workers = [threading.Thread(target=go_on) for _ in range(threads)]
    for worker in workers:
        worker.start()
    try:
        for i in count():
            if i >= MOVES and len(found) >= OUTPUTS:
                break
            structure = structures[(i + 1) % 2]
            layer.restructure(structure, th.full((structure.nnz,), 0.5))
    finally:
        done.set()
        for worker in workers:
            worker.join()
        sys.setswitchinterval(before)
    counts = (np.bincount(np.nonzero(mask)[0], minlength=shape[0]) for mask in masks)
    return found, {0.5 * float(count.max()) for count in counts}
