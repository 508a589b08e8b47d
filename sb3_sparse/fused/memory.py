"""Where a program's values lie."""

from __future__ import annotations

from collections.abc import Iterable

import torch as th

from sb3_sparse.fused.values import Value

TILE = 64


def lay_out(values: Iterable[Value], batch: int) -> tuple[th.Tensor, dict[Value, int]]:
    """Room for all values of a batch, and where each begins, in numbers.

    :param values: roots and views
    :param batch: the largest there will be
    """
    tiles = -(-batch // TILE)
    places: dict[Value, int] = {}
    at = 0
    for value in values:
        if value.root is value:
            places[value] = at
            at += value.features * TILE * (tiles if value.batched else 1)
    return th.zeros(at, dtype=th.float32, device="cpu"), places
