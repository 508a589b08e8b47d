"""Where the values of a graph lie in one static array, which as many as possible share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Activation, Conv, Flatten, MaxPool, Node, PerUnit, Slice

IN_PLACE = (Activation, PerUnit)
"""Nodes that may write over their input."""


@dataclass(frozen=True)
class Memory:
    """A plan.

    :param size: floats in the array
    :param places: first float of each value that lies in the array, by its number
    :param borders: first float of the bordered copy of a node's input, by the node's result
    """

    size: int
    places: dict[int, int]
    borders: dict[int, int]


def bordered_shape(node: Node, shape: tuple[int, ...]) -> tuple[int, ...] | None:
    """Shape of the bordered copy of its input that a node needs; None if it needs none."""
    if not isinstance(node, (Conv, MaxPool)) or not any(node.padding):
        return None
    units, *sizes = shape
    return (units, *(size + 2 * p for size, p in zip(sizes, node.padding, strict=True)))


def plan_memory(graph: Graph) -> Memory:
    """Place values first fit, each from the node that makes it to the last one that reads it.

    The observation and the action are the caller's and have no place.
    """
    last_value = len(graph.nodes)
    home = list(range(last_value + 1))
    """The value in whose place a value lies."""
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
    """Whether one node alone reads a value, or what it is another view of."""
    while len(graph.users(value)) == 1:
        node = graph.nodes[value - 1]
        if not isinstance(node, Flatten):
            return True
        value = node.inputs[0]
    return False
