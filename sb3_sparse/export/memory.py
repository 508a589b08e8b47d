"""Plans one static array for all values of a graph, which share it as far as possible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Activation, Conv, Flatten, MaxPool, Node, PerUnit, Slice

IN_PLACE = (Activation, PerUnit)
"""Nodes that may overwrite their input."""


@dataclass(frozen=True)
class Memory:
    """The layout of the array.

    :param size: number of floats
    :param places: index of the first float of each value in the array, by the value's number
    :param borders: index of the first float of bordered copies of inputs, by the node's result
    """

    size: int
    places: dict[int, int]
    borders: dict[int, int]


def bordered_shape(node: Node, shape: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return the shape of the bordered copy of its input that a node needs, or None."""
    if not isinstance(node, (Conv, MaxPool)) or not any(node.padding):
        return None
    units, *sizes = shape
    return (units, *(size + 2 * p for size, p in zip(sizes, node.padding, strict=True)))


def plan_memory(graph: Graph) -> Memory:
    """Place each value first-fit, from the node that makes it until the last one that reads it.

    The observation and the action belong to the caller and have no place.
    """
    last_value = len(graph.nodes)
    home = list(range(last_value + 1))
    """The value whose place each value uses."""
    last_use = [0] * (last_value + 1)
    for value, node in enumerate(graph.nodes, start=1):
        before = node.inputs[0]
        in_place = isinstance(node, IN_PLACE) and home[before] and _read_once(graph, before)
        if isinstance(node, (Flatten, Slice)) or in_place:
            home[value] = home[before] if value != last_value else value
        for taken in node.inputs:
            last_use[home[taken]] = value
    places: dict[int, int] = {}
    borders: dict[int, int] = {}
    taken_now: list[tuple[int, int, int]] = []  # start, end, last use
    size = 0

    def place(length: int, until: int, now: int) -> int:
        nonlocal size
        start = 0
        taken_now[:] = sorted(entry for entry in taken_now if entry[2] >= now)
        for begin, end, _ in taken_now:
            if start + length <= begin:
                break
            start = max(start, end)
        taken_now.append((start, start + length, until))
        size = max(size, start + length)
        return start

    for value, node in enumerate(graph.nodes, start=1):
        border = bordered_shape(node, graph.shape_of(node.inputs[0]))
        if border is not None:
            borders[value] = place(int(np.prod(border)), value, value)
        if home[value] == value and value != last_value:
            places[value] = place(int(np.prod(node.shape)), last_use[value], value)
        elif home[value] in places:
            places[value] = places[home[value]]
    return Memory(size, places, borders)


def _read_once(graph: Graph, value: int) -> bool:
    """Tell whether a single node reads a value, including the values that it is a view of."""
    while len(graph.users(value)) == 1:
        node = graph.nodes[value - 1]
        if not isinstance(node, Flatten):
            return True
        value = node.inputs[0]
    return False
