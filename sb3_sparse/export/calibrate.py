"""Turns the linear layers of a graph into whole numbers, with ranges from observations.

All ranges are symmetric: 0 stands for 0, so that no sum needs a correction for inputs it leaves
out. Weights have 8 bits and a scale for each row. Hidden values have as many bits as let no 32-bit
sum overflow, 16 at most: on a microcontroller they cost no more time than 8 bits.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.integers import (
    FRACTION,
    INSIDE,
    MOST,
    PARTS,
    Dequantized,
    Lookup,
    Quantize,
    Requantized,
)
from sb3_sparse.export.nodes import Activation, Linear, Node
from sb3_sparse.export.observations import Observations, count_of, rows_of
from sb3_sparse.export.parity import BATCH
from sb3_sparse.export.quantize import LARGEST, SMALLEST

PRODUCTS = 2**30 - 1
BIAS = 2**29 - 1
"""Largest sum of a row's products, and largest bias: with half of ``2^30`` they fit 32 bits."""
LEAST = 127
"""Hidden values have 8 bits or more."""
FARTHEST_SHIFT = 30
"""Half of ``2^30`` is what a row's bias may hold beside these two sums."""
HEADROOM = 2.0
"""Ranges are so many times the largest values seen."""
FLAT = {"tanh": 6.0, "sigmoid": 12.0}
"""Where a function has reached its bounds of 1 to 1e-5."""
TINY = 1e-300
"""Stands for the factor of a row without weights and bias, by which a number is divided."""
JUMPS = ("hardshrink", "threshold")
"""Functions that jump, so that lines between the points of a table are no match."""
LIMIT = 2**31 - 1
"""Largest 32-bit number."""


def integer_graph(graph: Graph, observations: Observations) -> Graph:
    """Return the graph with linear layers, and activations between them, in whole numbers.

    Other nodes stay floats; values that pass between both are quantized and dequantized.

    :param graph: the policy
    :param observations: recorded observations, from which the ranges of all values are taken
    :raises UnsupportedError: if a row has so many connections that its sum could overflow, or if
        there is no linear layer
    """
    if not any(isinstance(node, Linear) for node in graph.nodes):
        raise UnsupportedError("int8='full' needs a linear layer, and this policy has none")
    return _Conversion(graph, _largest(graph, observations)).graph()


def integer_values(graph: Graph) -> set[int]:
    """Return the values that become whole numbers.

    They are made by linear layers, or from such values by activations, and only linear layers and
    such activations read them.
    """
    found: set[int] = set()
    for value, node in enumerate(graph.nodes[:-1], start=1):
        table = isinstance(node, Activation) and node.kind not in JUMPS
        if isinstance(node, Linear) or (table and node.inputs[0] in found):
            found.add(value)
    while True:
        kept = {value for value in found if _fits(graph, value, found)}
        if kept == found:
            return found
        found = kept


def _fits(graph: Graph, value: int, found: set[int]) -> bool:
    node = graph.nodes[value - 1]
    return (isinstance(node, Linear) or node.inputs[0] in found) and all(
        isinstance(reader, Linear) or number in found
        for number, reader in enumerate(graph.nodes, start=1)
        if value in reader.inputs
    )


def _largest(graph: Graph, observations: Observations) -> list[NDArray[np.float64]]:
    """Return the least and the largest number that each unit of each value has, shape (2, n)."""
    found: list[NDArray[np.float64]] = []
    for first in range(0, count_of(observations), BATCH):
        values = graph.values(rows_of(observations, first, first + BATCH))
        flat = [value.reshape(-1, value.shape[-1]).astype(np.float64) for value in values]
        extremes = [np.stack([value.min(axis=1), value.max(axis=1)]) for value in flat]
        found = [
            np.stack([np.minimum(a[0], b[0]), np.maximum(a[1], b[1])])
            for a, b in zip(found or extremes, extremes, strict=True)
        ]
    return found


@dataclass
class _Conversion:
    """Makes the new nodes.

    :param extremes: the least and the largest number of each unit, by value
    """

    old: Graph
    extremes: list[NDArray[np.float64]]
    nodes: list[Node] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.whole = integer_values(self.old)
        self.relus = {
            value: readers[0]
            for value in self.whole
            if isinstance(self.old.nodes[value - 1], Linear)
            and len(readers := self._readers(value)) == 1
            and self.old.nodes[readers[0] - 1].name == "relu"
        }
        """ReLUs that the layer before computes, by that layer's value."""
        self.ranges: dict[int, Any] = {}
        """What the largest whole number of a value stands for; or that of each of its units."""
        self.places = {0: 0}
        """New numbers of the old graph's values."""
        self.quantized: dict[int, int] = {}
        """New numbers of floats that were quantized, by the value's old number."""

    def graph(self) -> Graph:
        """Return the new graph."""
        for value, node in enumerate(self.old.nodes, start=1):
            if isinstance(node, Linear):
                self.places[value] = self._linear(value, node)
            elif value in self.relus.values():
                self.places[value] = self.places[node.inputs[0]]
            elif value in self.whole:
                self.places[value] = self._lookup(value, node)
            else:
                inputs = tuple(self.places[taken] for taken in node.inputs)
                self.places[value] = self._add(replace(node, inputs=inputs))
        return replace(self.old, nodes=tuple(self.nodes))

    def _linear(self, value: int, layer: Linear) -> int:
        (taken,) = layer.inputs
        if taken not in self.whole:
            self._quantize(taken)
        most = self._most(taken)
        scale, numbers = _whole_weights(layer, self.ranges[taken], most)
        unit = scale / most
        weight = numbers.astype(np.int8)
        bias = _rounded(layer.bias, unit)
        place = self.places[taken] if taken in self.whole else self.quantized[taken]
        if value not in self.whole:
            _check_sums(numbers, most, bias)
            return self._add(
                Dequantized(
                    (place,), layer.shape, weight, bias.astype(np.int32), unit.astype(np.float32)
                )
            )
        result = self.relus.get(value, value)
        self.ranges[result] = max(self._range(result, layer), unit.max() * 2.0**FRACTION)
        largest = self._most(result)
        factor = unit * largest / self.ranges[result]
        free = largest / np.maximum(factor * 2.0**FRACTION, TINY)
        shift = np.clip(np.floor(np.log2(free)), 0, FARTHEST_SHIFT).astype(np.uint8)
        multiplier = np.minimum(np.rint(factor * 2.0 ** (FRACTION + shift)), largest)
        half = np.where(shift > 0, 2.0 ** (shift - 1.0), 0.0)
        _check_sums(numbers, most, bias, half)
        return self._add(
            Requantized(
                (place,),
                layer.shape,
                weight,
                (bias + half).astype(np.int32),
                multiplier.astype(np.uint16),
                shift,
                result != value,
            )
        )

    def _quantize(self, value: int) -> None:
        """Quantize a value that is no whole number, once."""
        if value in self.quantized:
            return
        self.ranges[value] = self._range_of_units(value)
        most = self._most(value)
        twice = (2.0 * most / self.ranges[value]).astype(np.float32)
        shape = self.old.shape_of(value)
        self.quantized[value] = self._add(Quantize((self.places[value],), shape, twice, most))

    def _lookup(self, value: int, node: Node) -> int:
        (taken,) = node.inputs
        self.ranges[value] = self._range(value, node)
        points = INSIDE * np.arange(-PARTS // 2, PARTS // 2 + 1)
        inputs = points * (self.ranges[taken] / self._most(taken))
        results = node.run(inputs[None])[0] / self.ranges[value] * self._most(value)
        table = np.rint(np.clip(results, -self._most(value), self._most(value)))
        return self._add(Lookup((self.places[taken],), node.shape, table.astype(np.int16)))

    def _add(self, node: Node) -> int:
        self.nodes.append(node)
        return len(self.nodes)

    def _readers(self, value: int) -> list[int]:
        nodes = enumerate(self.old.nodes, start=1)
        return [number for number, node in nodes if value in node.inputs]

    def _range(self, value: int, maker: Node) -> float:
        """Return the range of a hidden value.

        :param maker: the node that writes it; a layer that also computes the ReLU after it
        """
        if maker.name in FLAT:
            return 1.0
        most = HEADROOM * float(_positive(np.abs(self.extremes[value]).max()))
        kinds = [self.old.nodes[reader - 1].name for reader in self._readers(value)]
        most = min(most, max((FLAT.get(kind, np.inf) for kind in kinds), default=np.inf))
        # Shifts are whole, so that a row reaches at least half of its layer's range, not all of it.
        return 2.0 * most if isinstance(maker, Linear) else most

    def _range_of_units(self, value: int) -> NDArray[np.float64]:
        """Return the ranges of the units of a value that is quantized.

        A unit that never moved tells nothing about its range; it gets the median of the others.
        """
        least, greatest = self.extremes[value]
        most = np.maximum(np.abs(least), np.abs(greatest))
        moved = least < greatest
        usual = np.median(most[moved]) if moved.any() else 1.0
        ranges: NDArray[np.float64] = HEADROOM * _positive(
            np.where(moved, most, np.maximum(most, usual))
        )
        return ranges

    def _most(self, value: int) -> int:
        """Return the largest whole number of a value: no sum that reads it may overflow."""
        most = MOST
        for reader in self._readers(value):
            layer = self.old.nodes[reader - 1]
            if not isinstance(layer, Linear):
                continue
            _, numbers = _whole_weights(layer, self.ranges[value])
            most = min(most, int(PRODUCTS // max(np.abs(numbers).sum(axis=1).max(), 1.0)))
        if most < LEAST:
            raise UnsupportedError(
                "a row of a linear layer has so many connections that the sum of their 8-bit "
                "products may exceed 32 bits; export it with int8='weights' (--int8 weights)"
            )
        return most


def _whole_weights(
    layer: Linear, ranges: Any, most: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the scale of each row, and its weights as 8-bit numbers.

    :param ranges: of the inputs, which are divided by them
    :param most: largest whole number of an input, by which the scale makes the bias small enough;
        0: the bias is left out of account, which makes no number smaller
    """
    weight = layer.weight.astype(np.float64) * ranges
    largest = np.abs(weight).max(axis=1, initial=0.0)
    scale = np.maximum(largest / LARGEST, np.abs(layer.bias.astype(np.float64)) * most / BIAS)
    return scale, _rounded(weight, scale[:, None])


def _check_sums(
    weights: NDArray[np.float64], most: int, bias: NDArray[np.float64], half: Any = 0.0
) -> None:
    """Assert that no sum of a layer overflows, whatever its inputs."""
    assert (np.abs(weights).sum(axis=1) * most + np.abs(bias) + half).max() <= LIMIT


def _rounded(numbers: NDArray[Any], unit: NDArray[Any]) -> NDArray[np.float64]:
    """Return ``numbers / unit`` rounded; 0 where the unit is 0, since all is 0 there."""
    return np.rint(np.asarray(numbers, np.float64) / np.where(unit > 0, unit, 1.0))


def _positive(most: Any) -> Any:
    """Return ranges above 0: those of a value that is always 0 are of no importance."""
    return np.where(most > SMALLEST, most, 1.0)
