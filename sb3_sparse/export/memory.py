"""Plans the static arrays of a graph's values, which share them as far as possible."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.integers import Lookup
from sb3_sparse.export.nodes import (
    Activation,
    Conv,
    Flatten,
    MaxPool,
    Node,
    Pairwise,
    PerUnit,
    Slice,
    Standardize,
)

IN_PLACE = (Activation, PerUnit, Standardize, Pairwise, Lookup)
"""Nodes that may overwrite an input that nothing reads later."""


@dataclass(frozen=True)
class Memory:
    """The layout of an array of floats, and one of 16-bit whole numbers.

    :param size: number of floats
    :param places: index of the first element of each value in its array, by the value's number
    :param borders: index of the first float of bordered copies of inputs, by the node's result
    :param whole: number of whole numbers
    """

    size: int
    places: dict[int, int]
    borders: dict[int, int]
    whole: int = 0

    @property
    def bytes(self) -> int:
        """Bytes of both arrays."""
        return 4 * self.size + 2 * self.whole


@dataclass
class _Array:
    """An array in which values are placed first-fit."""

    size: int = 0
    taken: list[tuple[int, int, int]] = field(default_factory=list)
    """Start, end and last use of values."""

    def place(self, length: int, until: int, now: int) -> int:
        start = 0
        self.taken = sorted(entry for entry in self.taken if entry[2] >= now)
        for begin, end, _ in self.taken:
            if start + length <= begin:
                break
            start = max(start, end)
        self.taken.append((start, start + length, until))
        self.size = max(self.size, start + length)
        return start


def bordered_shape(node: Node, shape: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return the shape of the bordered copy of its input that a node needs, or None."""
    if not isinstance(node, (Conv, MaxPool)) or not any(node.padding):
        return None
    units, *sizes = shape
    return (units, *(size + 2 * p for size, p in zip(sizes, node.padding, strict=True)))


def plan_memory(graph: Graph) -> Memory:
    """Place each value first-fit, from the node that makes it until the last one that reads it.

    The observation and the outputs belong to the caller and have no place.
    """
    outputs = {output.value for output in graph.outputs}
    home = _homes(graph, outputs)
    last_use = [0] * (len(graph.nodes) + 1)
    for value, node in enumerate(graph.nodes, start=1):
        for taken in node.inputs:
            last_use[home[taken]] = value
    places: dict[int, int] = {}
    borders: dict[int, int] = {}
    floats, whole = _Array(), _Array()
    for value, node in enumerate(graph.nodes, start=1):
        border = bordered_shape(node, graph.shape_of(node.inputs[0]))
        if border is not None:
            borders[value] = floats.place(int(np.prod(border)), value, value)
        if home[value] == value and value not in outputs:
            array = whole if node.whole else floats
            places[value] = array.place(int(np.prod(node.shape)), last_use[value], value)
        elif home[value] in places:
            places[value] = places[home[value]]
    return Memory(floats.size, places, borders, whole.size)


def _homes(graph: Graph, outputs: set[int]) -> list[int]:
    """Return for each value the one whose place it uses: itself, or an input of its node."""
    last_reader = [0] * (len(graph.nodes) + 1)
    for value, node in enumerate(graph.nodes, start=1):
        for taken in node.inputs:
            last_reader[taken] = value
    home = list(range(len(graph.nodes) + 1))
    for value, node in enumerate(graph.nodes, start=1):
        if value in outputs:
            continue
        if isinstance(node, (Flatten, Slice)):
            home[value] = home[node.inputs[0]]
        elif isinstance(node, IN_PLACE):
            needed = {home[before] for before in range(value) if last_reader[before] > value}
            needed |= {0, *outputs}
            free = (home[taken] for taken in node.inputs if home[taken] not in needed)
            home[value] = next(free, value)
    return home
