"""Where a program's values lie."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch as th

from sb3_sparse.engine.products import TILE
from sb3_sparse.fused.operations import Operation
from sb3_sparse.fused.values import Value


class Place(NamedTuple):
    """Where a value lies, in numbers.

    :param at: of its first number
    :param thread: how far apart threads are; 0: they share it
    :param tile: how far apart tiles are; 0: one is written over the other
    """

    at: int
    thread: int
    tile: int


class Memory:
    """Room for the values of a program.

    A value that is made and read in one phase alone needs room for a tile of each thread, which is
    used again as soon as nobody reads it any more. So the cache holds what a tile needs.

    :param operations: in the order in which they run
    :param values: all there are
    :param batch: the largest there will be
    :param threads: how many may share the tiles
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
        room = _Room()
        for number, operation in enumerate(operations):
            roots = {value.root for value in _values_of(operation)} & local
            for value in roots:
                if uses[value][1] == number:
                    self.places[value] = Place(at + room.take(value.features * TILE), -1, 0)
            for value in roots:
                if uses[value][2] == number:
                    room.give(value.features * TILE, self.places[value].at - at)
        self.places = {
            value: place._replace(thread=room.size) if place.thread else place
            for value, place in self.places.items()
        }
        self.work = th.zeros(at + threads * room.size, dtype=th.float32, device="cpu")


class _Room:
    """Memory that is taken and given back."""

    def __init__(self) -> None:
        self.size = 0
        self._free: dict[int, list[int]] = defaultdict(list)

    def take(self, size: int) -> int:
        """Where there is room for so many numbers."""
        if self._free[size]:
            return self._free[size].pop()
        self.size += size
        return self.size - size

    def give(self, size: int, at: int) -> None:
        """Nobody needs it any more."""
        self._free[size].append(at)


def _values_of(operation: Operation) -> list[Value]:
    return [*operation.operands, *([] if operation.to is None else [operation.to])]


def _uses(operations: Sequence[Operation]) -> dict[Value, tuple[set[int], int, int]]:
    """The phases that use each value (-1: an operation between phases), its first and last use."""
    found: dict[Value, tuple[set[int], int, int]] = {}
    phase = 0
    for number, operation in enumerate(operations):
        if not operation.tiled:
            phase += 1
        for value in _values_of(operation):
            phases, first, _ = found.get(value.root, (set(), number, number))
            found[value.root] = phases | {phase if operation.tiled else -1}, first, number
    return found
