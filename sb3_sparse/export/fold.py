"""Folds scales and shifts into neighbouring layers, which changes nothing but rounding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Affine, Conv, Node, Weighted


def fold(graph: Graph) -> Graph:
    """Remove the :class:`Affine` nodes that a neighbouring layer can compute, and unread values.

    Batch normalisation and the division of pixels by 255 disappear this way.
    """
    for number in range(len(graph.nodes)):
        if not graph.users(number + 1) and graph.name_of(number + 1) is None:
            return fold(rewrite(graph, {number: None}))
    for number, node in enumerate(graph.nodes):
        if isinstance(node, Affine):
            changed = _into_producer(graph, number, node) or _into_users(graph, number, node)
            if changed:
                return fold(rewrite(graph, {**changed, number: None}))
    return graph


def rewrite(graph: Graph, changed: Mapping[int, Node | None]) -> Graph:
    """Replace or remove nodes of a graph; users of a removed node read its input instead.

    :param changed: new nodes by number; None removes a node
    """
    places = [0]
    nodes: list[Node] = []
    for number, node in enumerate(graph.nodes):
        new = changed.get(number, node)
        inputs = tuple(places[value] for value in node.inputs)
        if new is None:
            places.append(inputs[0])
            continue
        nodes.append(replace(new, inputs=inputs))
        places.append(len(nodes))
    chosen = tuple(replace(one, value=places[one.value]) for one in graph.chosen)
    return replace(graph, nodes=tuple(nodes), chosen=chosen)


def _into_producer(graph: Graph, number: int, node: Affine) -> dict[int, Node]:
    """Fold a node into the rows of the layer before, if nothing else needs that layer's result."""
    (value,) = node.inputs
    layer = graph.nodes[value - 1] if value else None
    needed = len(graph.users(value)) > 1 or graph.name_of(value) is not None
    if not isinstance(layer, Weighted) or needed:
        return {}
    scale = node.scale.astype(np.float64)
    weight = layer.weight * scale.reshape(-1, *[1] * (layer.weight.ndim - 1))
    bias = layer.bias * scale + node.shift
    return {value - 1: with_weights(layer, weight, bias)}


def _into_users(graph: Graph, number: int, node: Affine) -> dict[int, Node]:
    """Fold a node into the columns of its users, if all are layers without a border of zeros."""
    changed: dict[int, Node] = {}
    if graph.name_of(number + 1) is not None:
        return changed
    for user, layer in enumerate(graph.nodes):
        if number + 1 not in layer.inputs:
            continue
        bordered = isinstance(layer, Conv) and any(layer.padding) and node.shift.any()
        if not isinstance(layer, Weighted) or bordered:
            return {}
        columns = (1, -1, *[1] * (layer.weight.ndim - 2))
        weight = layer.weight.astype(np.float64)
        shifts = (weight * node.shift.reshape(columns)).reshape(len(weight), -1).sum(axis=1)
        changed[user] = with_weights(
            layer, weight * node.scale.reshape(columns), layer.bias + shifts
        )
    return changed


def with_weights(layer: Weighted, weight: NDArray[Any], bias: NDArray[Any]) -> Weighted:
    """Return the layer with other weights, in float32."""
    return replace(layer, weight=weight.astype(np.float32), bias=bias.astype(np.float32))
