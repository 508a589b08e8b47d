"""Removes and reorders units without changing the function."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.fold import with_weights
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import (
    Activation,
    Argmax,
    Concat,
    Conv,
    Flatten,
    Linear,
    MaxPool,
    Node,
    Normalize,
    Pairwise,
    PerUnit,
    Positive,
    Standardize,
    Weighted,
)
from sb3_sparse.export.output_nodes import Largest

UNIT_BY_UNIT = (Activation, PerUnit, Flatten, MaxPool, Normalize)
"""Nodes whose result has the same units as their input."""
ALL_UNITS = (Pairwise, Concat, Standardize, Argmax, Largest, Positive)
"""Nodes that need all units of their inputs, even constant ones."""


def remove_dead_units(graph: Graph) -> Graph:
    """Remove units that are constant or unread.

    A unit without active inputs, or with constant ones only, has a constant value, which is added
    to the biases of the layers that read it. A unit that nothing reads is removed together with its
    connections. Observations, outputs, their scores and the ends of residual connections keep all
    their units.
    """
    constants = _Constants(graph)
    nodes = [
        _without_constants(node, number + 1, constants) if isinstance(node, Weighted) else node
        for number, node in enumerate(graph.nodes)
    ]
    return select_units(replace(graph, nodes=tuple(nodes)), _kept_units(graph, constants))


def sort_units(graph: Graph) -> Graph:
    """Sort the units of every hidden linear layer by their number of inputs.

    Neighbouring rows then have similar numbers of connections, as fast code needs.
    """
    constants = _Constants(graph)
    order = {
        value: np.argsort(np.count_nonzero(node.weight, axis=1), kind="stable")
        for value, node in enumerate(graph.nodes, start=1)
        if isinstance(node, Linear) and not constants.pinned[value].any()
    }
    return select_units(graph, order)


def select_units(graph: Graph, chosen: Mapping[int, NDArray[np.intp]]) -> Graph:
    """Remove or reorder units of a graph.

    :param chosen: indices of the remaining units by number of the value; other values are unchanged
    """
    units = [np.arange(graph.observation_shape[0])]
    nodes: list[Node] = []
    for number, node in enumerate(graph.nodes):
        before = units[node.inputs[0]]
        if isinstance(node, Weighted):
            rows = chosen.get(number + 1, np.arange(len(node.weight)))
            weight = node.weight[rows][:, before]
            shape = (len(rows), *node.shape[1:])
            node = replace(node, weight=weight, bias=node.bias[rows], shape=shape)
            units.append(rows)
        elif isinstance(node, Flatten):
            places = node.shape[0] // graph.shape_of(node.inputs[0])[0]
            spread = (before[:, None] * places + np.arange(places)).reshape(-1)
            units.append(spread)
            node = replace(node, shape=(len(spread),))
        elif isinstance(node, UNIT_BY_UNIT):
            units.append(before)
            fields: dict[str, Any] = {}
            if isinstance(node, PerUnit):
                fields = {name: getattr(node, name)[before] for name in node.names}
            node = replace(node, shape=(len(before), *node.shape[1:]), **fields)
        else:
            units.append(np.arange(node.shape[0]))
        nodes.append(node)
    return replace(graph, nodes=tuple(nodes))


def units_of(graph: Graph) -> int:
    """Count the units of all layers: outputs of linear layers, channels of convolutions."""
    return sum(len(layer.bias) for layer in graph.layers)


class _Constants:
    """The constant units of a graph.

    ``known[v]`` is the constant of each unit of value ``v``, NaN for units that vary;
    ``pinned[v]`` is true for units that must stay even if they are constant.
    """

    def __init__(self, graph: Graph) -> None:
        units = [graph.shape_of(value)[0] for value in range(len(graph.nodes) + 1)]
        self.known = [np.full(count, np.nan) for count in units]
        self.pinned = [np.zeros(count, bool) for count in units]
        self.source = list(range(len(units)))
        """The value that each value shares its units with."""
        for number, node in enumerate(graph.nodes):
            value = number + 1
            if isinstance(node, UNIT_BY_UNIT):
                self.source[value] = self.source[node.inputs[0]]
            if isinstance(node, Weighted):
                self.known[value] = self._of_layer(node)
            elif isinstance(node, ALL_UNITS):
                for operand in node.inputs:
                    self.pinned[self.source[operand]][:] = True
                self.pinned[value][:] = True
            elif isinstance(node, Flatten):
                known = self.known[node.inputs[0]]
                self.known[value] = np.repeat(known, units[value] // len(known))
            elif isinstance(node, MaxPool):
                self.known[value] = self.known[node.inputs[0]]
            elif isinstance(node, (Activation, PerUnit)) and len(node.shape) == 1:
                self.known[value] = node.run(self.known[node.inputs[0]][:, None])[:, 0]
            elif isinstance(node, (Activation, PerUnit)):
                known = self.known[node.inputs[0]]
                self.known[value] = node.run(known[:, None, None, None])[:, 0, 0, 0]
        for value in (0, *(output.value for output in graph.outputs)):
            self.pinned[self.source[value]][:] = True

    def _of_layer(self, layer: Weighted) -> NDArray[np.float64]:
        """Return constants of a layer's outputs, and pin inputs that its bias cannot absorb."""
        (value,) = layer.inputs
        known = self.known[value]
        if isinstance(layer, Conv) and any(layer.padding):
            self.pinned[self.source[value]] |= known > 0  # at the border they alternate with zeros
            self.pinned[self.source[value]] |= known < 0
        foldable = self.foldable(layer)
        moving = _connected(layer)[:, ~foldable].any(axis=1)
        return np.where(moving, np.nan, self.bias(layer))

    def foldable(self, layer: Weighted) -> NDArray[np.bool_]:
        """Tell which inputs of a layer are constant at every place it reads."""
        known = self.known[layer.inputs[0]]
        if isinstance(layer, Conv) and any(layer.padding):
            constant: NDArray[np.bool_] = known == 0
            return constant
        constant = ~np.isnan(known)
        return constant

    def bias(self, layer: Weighted) -> NDArray[np.float64]:
        """Return a layer's bias plus the contribution of its constant inputs."""
        foldable = self.foldable(layer)
        columns = layer.weight.astype(np.float64).reshape(len(layer.weight), foldable.size, -1)
        total: NDArray[np.float64] = (
            layer.bias + columns[:, foldable].sum(axis=2) @ (self.known[layer.inputs[0]][foldable])
        )
        return total


def _connected(layer: Weighted) -> NDArray[np.bool_]:
    """Tell which outputs and inputs are connected, shape ``(outputs, inputs)``."""
    weight = layer.weight.reshape(*layer.weight.shape[:2], -1)
    connected: NDArray[np.bool_] = (weight != 0).any(axis=2)
    return connected


def _kept_units(graph: Graph, constants: _Constants) -> dict[int, NDArray[np.intp]]:
    """Return the indices of the units of each layer that stay."""
    read = [pinned.copy() for pinned in constants.pinned]
    for number in reversed(range(len(graph.nodes))):
        node, result = graph.nodes[number], read[number + 1]
        if isinstance(node, Weighted):
            rows = result & np.isnan(constants.known[number + 1])
            columns = _connected(node)[rows].any(axis=0) & ~constants.foldable(node)
            read[node.inputs[0]] |= columns
        elif isinstance(node, UNIT_BY_UNIT):
            units = len(read[node.inputs[0]])
            read[node.inputs[0]] |= result.reshape(units, -1).any(axis=1)
    kept = {}
    for value, node in enumerate(graph.nodes, start=1):
        if isinstance(node, Weighted):
            moving = np.isnan(constants.known[value]) | constants.pinned[value]
            stays = read[value] & moving
            stays[0] |= not stays.any()  # a layer needs a unit
            kept[value] = np.flatnonzero(stays)
    return kept


def _without_constants(layer: Weighted, value: int, constants: _Constants) -> Weighted:
    """Move a layer's constant inputs into its bias."""
    weight = layer.weight.copy()
    weight[:, constants.foldable(layer)] = 0.0
    weight[~np.isnan(constants.known[value])] = 0.0
    return with_weights(layer, weight, constants.bias(layer))
