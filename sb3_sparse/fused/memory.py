"""Lays out a program's values in memory."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch as th

from sb3_sparse.engine.products import TILE
from sb3_sparse.fused.operations import Operation
from sb3_sparse.fused.values import Value


class Place(NamedTuple):
    """Position of a value in memory, counted in numbers.

    :param at: position of its first number
    :param thread: distance between threads; 0: they share it
    :param tile: distance between tiles; 0: they overwrite each other
    """

    at: int
    thread: int
    tile: int


class Memory:
    """Allocates the values of a program.

    A value that is written and read within one phase needs only one tile for each thread, and its
    memory is reused after the last read. So the values of a tile fit the cache.

    :param operations: in the order in which they run
    :param values: all values
    :param batch: maximum batch size
    :param threads: number of threads that may share the tiles
    """

    def __init__(
        self, operations: Sequence[Operation], values: Iterable[Value], batch: int, threads: int
    ) -> None:
        tiles = -(-batch // TILE)
        uses = _uses(operations)
        local = {
            value for value, (phases, _, _) in uses.items()
            if value.batched and len(phases) == 1 and -1 not in phases
        }  # fmt: skip
        self.places: dict[Value, Place] = {}
        at = 0
        for value in values:
            if value.root is value and value not in local:
                size = value.features * TILE
                self.places[value] = Place(at, 0, size if value.batched else 0)
                at += size * (tiles if value.batched else 1)
        pool = _Pool()
        for number, operation in enumerate(operations):
            roots = {value.root for value in _values_of(operation)} & local
            for value in roots:
                if uses[value][1] == number:
                    self.places[value] = Place(at + pool.take(value.features * TILE), -1, 0)
            for value in roots:
                if uses[value][2] == number:
                    pool.give(value.features * TILE, self.places[value].at - at)
        self.places = {
            value: place._replace(thread=pool.size) if place.thread else place
            for value, place in self.places.items()
        }
        self.work = th.zeros(at + threads * pool.size, dtype=th.float32, device="cpu")


class _Pool:
    """Hands out memory and takes it back."""

    def __init__(self) -> None:
        self.size = 0
        self._free: dict[int, list[int]] = defaultdict(list)

    def take(self, size: int) -> int:
        """Allocate so many numbers; return their position."""
        if self._free[size]:
            return self._free[size].pop()
        self.size += size
        return self.size - size

    def give(self, size: int, at: int) -> None:
        """Return memory to the pool."""
        self._free[size].append(at)


def _values_of(operation: Operation) -> list[Value]:
    return [*operation.operands, *([] if operation.to is None else [operation.to])]


def _uses(operations: Sequence[Operation]) -> dict[Value, tuple[set[int], int, int]]:
    """Find the phases that use each value (-1: between phases), and its first and last use."""
    found: dict[Value, tuple[set[int], int, int]] = {}
    phase = 0
    for number, operation in enumerate(operations):
        if not operation.tiled:
            phase += 1
        for value in _values_of(operation):
            phases, first, _ = found.get(value.root, (set(), number, number))
            found[value.root] = phases | {phase if operation.tiled else -1}, first, number
    return found
