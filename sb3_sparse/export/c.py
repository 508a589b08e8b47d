"""A policy as one C99 file that depends on nothing, and its header."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export import ckernels
from sb3_sparse.export.cfunctions import FUNCTIONS
from sb3_sparse.export.cheader import about, declarations, prototype
from sb3_sparse.export.cintegers import integer_call
from sb3_sparse.export.ctables import BYTES, Tables, number
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.inexact import inexact_quantizations
from sb3_sparse.export.integers import IntegerLinear, Lookup, Quantize
from sb3_sparse.export.layout import grouped, index_bits, is_smaller_dense, side_by_side
from sb3_sparse.export.memory import Memory, bordered_shape, plan_memory
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
    OneHot,
    Pairwise,
    PerUnit,
    Positive,
    Slice,
    Standardize,
    Weighted,
)
from sb3_sparse.export.output_nodes import Constant, Largest
from sb3_sparse.export.quantize import quantize_rows

CHECK = "SB3_SPARSE_CHECK"
"""The macro under which a policy keeps the whole numbers that its inexact floats became."""
CHECKED = "sb3_sparse_quantized"
"""The array in which it keeps them."""


@dataclass(frozen=True)
class CSource:
    """A C file and its header.

    :param source: text of the ``.c`` file
    :param header: text of the ``.h`` file
    :param flash: bytes of its constants, without some 1 to 3 KB of code
    :param ram: bytes of its static memory, without the caller's observation and outputs
    """

    source: str
    header: str
    flash: int
    ram: int


def write_c(graph: Graph, version: str, int8: bool = False) -> CSource:
    """Write a graph as C99.

    :param graph: the policy; its hidden units should be sorted
    :param version: version of this package, for the files' first lines
    :param int8: store weights as 8-bit whole numbers with a scale for each row
    """
    writer = _Writer(graph, plan_memory(graph), int8)
    for value, node in enumerate(graph.nodes, start=1):
        writer.write(value, node)
    tables = "\n".join(writer.tables.texts)
    functions = "\n".join(writer.functions.values())
    body = "\n".join(line if line.startswith("#") else f"    {line}" for line in writer.calls)
    ram = writer.memory.bytes
    arrays = {"float memory": writer.memory.size, "int16_t whole": writer.memory.whole}
    memory = "".join(f"static {name}[{size}];\n\n" for name, size in arrays.items() if size)
    memory += writer.kept_numbers()
    comment = about(graph, version, writer.tables.bytes, ram)
    includes = "#include <stdint.h>\n"
    if any(f"{name}(" in functions for name in ckernels.MATH):
        includes = "#include <math.h>\n" + includes
    source = (
        f"{comment}{includes}\n{prototype(graph)};\n\n{memory}{functions}\n{tables}\n\n"
        f"{prototype(graph)}\n{{\n{body}\n}}\n"
    )
    header = comment + declarations(graph)
    return CSource(source, header, writer.tables.bytes, ram)


class _Writer:
    """Collects functions, tables and calls."""

    def __init__(self, graph: Graph, memory: Memory, int8: bool) -> None:
        self.graph = graph
        self.memory = memory
        self.int8 = int8
        self.tables = Tables()
        self.functions: dict[str, str] = {}
        self.calls: list[str] = []
        self.kept: dict[int, int] = {}
        """Where the numbers of inexact quantizations begin in the array that a check reads."""
        self.kept_size = 0
        for value in inexact_quantizations(graph):
            self.kept[value] = self.kept_size
            self.kept_size += int(np.prod(graph.shape_of(value)))

    def kept_numbers(self) -> str:
        """Return the declaration of that array, which only a check compiles."""
        if not self.kept:
            return ""
        return (
            f"#ifdef {CHECK}\n/* What floats became, for a check that may add them up in another "
            f"order. */\nint16_t {CHECKED}[{self.kept_size}];\n#endif\n\n"
        )

    def write(self, value: int, node: Node) -> None:
        """Append the code that computes a node's result."""
        self.value = value
        x, y = self._place(node.inputs[0]), self._place(value)
        if isinstance(node, Linear):
            self._linear(node, x, y)
        elif isinstance(node, Conv):
            self._conv(node, x, y)
        elif isinstance(node, (Quantize, IntegerLinear, Lookup)):
            name, arguments, sources = integer_call(node, self._table)
            self.functions |= sources
            self._call(name, x, y, *arguments, source=sources[name])
            if value in self.kept:
                again = f"{CHECKED} + {self.kept[value]}"
                self.calls.append(f"#ifdef {CHECK}")
                self._call(name, x, again, *arguments, source=sources[name])
                self.calls.append("#endif")
        elif isinstance(node, MaxPool):
            self._max_pool(node, x, y)
        elif isinstance(node, (Argmax, OneHot)):
            sizes = self._table("sizes", node.sizes, "uint32_t")
            self._call(node.op, x, y, len(node.sizes), sizes)
        elif isinstance(node, Standardize):
            self._call("standardize", x, y, _size(node), number(node.eps))
        elif isinstance(node, Largest):
            self._call("largest", x, y, int(np.prod(self.graph.shape_of(node.inputs[0]))))
        elif isinstance(node, Constant):
            numbers = self._table("numbers", node.numbers, "float")
            self._call("copy_each", numbers, y, _size(node))
        elif isinstance(node, Concat):
            start = 0
            for part in node.inputs:
                size = int(np.prod(self.graph.shape_of(part)))
                self._call("copy_each", self._place(part), f"{y} + {start}", size)
                start += size
        elif isinstance(node, PerUnit):
            places = int(np.prod(node.shape[1:]))
            self._elementwise(node, x, y, [node.shape[0], places], node.fields())
        elif isinstance(node, Normalize):
            fields = node.fields()
            fields["clip"] = np.array(node.clip, np.float32)
            self._elementwise(node, x, y, [_size(node)], fields)
        elif isinstance(node, Activation):
            self._elementwise(node, x, y, [_size(node)], node.fields())
        elif isinstance(node, Pairwise):
            self._elementwise(node, x, y, [_size(node), self._place(node.inputs[1])], {})
        elif isinstance(node, Positive):
            self._elementwise(node, x, y, [_size(node)], {})
        else:
            assert isinstance(node, (Flatten, Slice))  # the same numbers in the same order
            assert self.graph.name_of(value) is None  # the caller's array would stay unwritten

    def _call(self, function: str, *arguments: object, source: str = "") -> None:
        """Append a call.

        :param source: text of the function; by default that in :data:`FUNCTIONS`
        """
        self.functions[function] = source or FUNCTIONS[function]
        self.calls.append(f"{function}({', '.join(map(str, arguments))});")

    def _elementwise(
        self, node: Node, x: str, y: str, size: list[object], fields: dict[str, NDArray[Any]]
    ) -> None:
        arguments = [
            self._table(name, field, "float") if field.ndim else number(field)
            for name, field in fields.items()
        ]
        kind = node.op if isinstance(node, PerUnit) else node.name
        function = ckernels.elementwise(kind)
        for name, helper in ckernels.HELPERS.items():
            if f"{name}(" in function:
                self.functions[name] = helper
        self._call(ckernels.c_name(kind), x, y, *size, *arguments, source=function)

    def _linear(self, layer: Linear, x: str, y: str) -> None:
        rows, scales = self._rows(layer)
        longest = int(np.count_nonzero(rows, axis=1).max())
        bits = index_bits(rows.shape[1], longest)
        if is_smaller_dense(rows, BYTES[self._type], bits):
            name, source_bits = "linear_dense" + "_int8" * self.int8, None
            tables = [str(rows.shape[1]), self._table("value", side_by_side(rows), self._type)]
        else:
            name, source_bits = f"linear_{bits}" + "_int8" * self.int8, bits
            lengths, columns, values = grouped(rows)
            index = ckernels.INDEX_TYPES[bits]
            tables = [
                self._table("length", lengths, index),
                self._table("column", columns, index),
                self._table("value", values, self._type),
            ]
        tables += self._scale_and_bias(layer, scales)
        source = ckernels.linear(name, source_bits, self.int8)
        self._call(name, x, y, len(rows), *tables, source=source)

    def _conv(self, layer: Conv, x: str, y: str) -> None:
        x, shape = self._bordered(layer, x, 0.0)
        rows, scales = self._rows(layer)
        _, inputs, height, width = layer.weight.shape
        across = shape[2]
        places = np.arange(int(np.prod(shape))).reshape(shape)[:, :height, :width].reshape(-1)
        active = [np.flatnonzero(row) for row in rows]
        bits = index_bits(places.max() + 1, max(map(len, active)))
        full = bool((rows != 0).all())
        index = ckernels.INDEX_TYPES[bits]
        name = f"conv_{bits}" + "_full" * full + "_int8" * self.int8
        if full:
            tables = [str(rows.shape[1]), self._table("offset", places, index)]
        else:
            tables = [
                self._table("length", [len(found) for found in active], index),
                self._table("offset", np.concatenate([places[found] for found in active]), index),
            ]
        values = np.concatenate([row[found] for row, found in zip(rows, active, strict=True)])
        tables.append(self._table("value", values, self._type))
        tables += self._scale_and_bias(layer, scales)
        steps = (across * layer.stride[0], layer.stride[1])
        source = ckernels.conv(name, bits, full, self.int8)
        self._call(name, x, y, *layer.shape, *steps, *tables, source=source)

    def _scale_and_bias(self, layer: Weighted, scales: NDArray[Any]) -> list[str]:
        scale = [self._table("scale", scales, "float")] if self.int8 else []
        return [*scale, self._table("bias", layer.bias, "float")]

    def _max_pool(self, node: MaxPool, x: str, y: str) -> None:
        x, (_, height, width) = self._bordered(node, x, -float(np.finfo(np.float32).max))
        sizes = [*node.shape, height * width, width, width * node.stride[0], node.stride[1]]
        self._call("max_pool", x, y, *sizes, *node.kernel)

    def _bordered(self, node: Conv | MaxPool, x: str, border: float) -> tuple[str, tuple[int, ...]]:
        """Add a border to a node's input if it needs one; return the input and its shape."""
        shape = self.graph.shape_of(node.inputs[0])
        with_border = bordered_shape(node, shape)
        if with_border is None:
            return x, shape
        y = f"memory + {self.memory.borders[self.value]}"
        self._call("bordered", x, y, *shape, *node.padding, number(border))
        return y, with_border

    def _rows(self, layer: Weighted) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return a layer's weights as they are written, by rows, and the scale of each row."""
        if self.int8:
            return quantize_rows(layer.rows)
        return layer.rows, np.ones(len(layer.rows), np.float32)

    @property
    def _type(self) -> str:
        return "int8_t" if self.int8 else "float"

    def _place(self, value: int) -> str:
        if value == 0:
            return "obs"
        output = self.graph.name_of(value)
        if output is not None:
            return output
        if value not in self.memory.places:  # an observation, or a part of it, perhaps flattened
            node = self.graph.nodes[value - 1]
            before = self._place(node.inputs[0])
            return f"{before} + {node.start}" if isinstance(node, Slice) else before
        array = "whole" if self.graph.nodes[value - 1].whole else "memory"
        return f"{array} + {self.memory.places[value]}"

    def _table(self, name: str, numbers: Any, kind: str) -> str:
        """Append a constant array of the node and return its name."""
        return self.tables.add(f"{name}_{self.value}", numbers, kind)


def _size(node: Node) -> str:
    return str(int(np.prod(node.shape)))
