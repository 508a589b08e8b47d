"""The C functions of operations on whole numbers, and how they are called."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from string import Template
from typing import Any

import numpy as np

from sb3_sparse.export.cheader import WIDTH
from sb3_sparse.export.ckernels import INDEX_TYPES
from sb3_sparse.export.integers import (
    MOST,
    Dequantized,
    IntegerLinear,
    Lookup,
    Quantize,
    Requantized,
)
from sb3_sparse.export.layout import index_bits, is_smaller_dense
from sb3_sparse.export.nodes import Node

Table = Callable[[str, Any, str], str]
"""Writes a constant array, given its name, numbers and type, and returns how C calls it."""
UNROLLED = 4
"""Connections of a row in each turn of its loop."""
INDENT = 18
"""Spaces before further lines of parameters."""
CHECK = """\
/* Fails to compile where a shift to the right does not keep the sign. */
typedef char shifts_keep_the_sign[((int32_t)-1 >> 1) == -1 ? 1 : -1];
"""
QUANTIZE = """\
/* Floats as whole numbers: times twice, cut, halved, with halves away from 0. */
static void quantize(const float *x, int16_t *y, uint32_t n, const float *twice, float bound)
{
    uint32_t i;
    for (i = 0; i < n; i++) {
        float a = x[i] * twice[i];
        int32_t twofold;
        a = a < bound ? a : bound; /* NaN, too */
        a = a > -bound ? a : -bound;
        twofold = (int32_t)a;
        y[i] = (int16_t)((twofold + (twofold < 0 ? -1 : 1)) / 2);
    }
}
"""
LOOKUP = """\
/* A function by a table of 257 points, with straight lines between them. */
static void lookup(const int16_t *x, int16_t *y, uint32_t n, const int16_t *table)
{
    uint32_t i;
    for (i = 0; i < n; i++) {
        const uint32_t at = (uint32_t)((int32_t)x[i] + 32768);
        const int16_t *point = table + (at >> 8);
        const int32_t low = point[0], rise = point[1] - low;
        y[i] = (int16_t)(low + ((rise * (int32_t)(at & 255) + 128) >> 8));
    }
}
"""
LINEAR = Template("""\
/* Sums of 8-bit weights times 16-bit inputs; none of them exceeds 32 bits. */
$signature)
{
    for (; rows; rows--) {
$start
        for (; n >= $unrolled; n -= $unrolled, value += $unrolled, $at += $unrolled) {
$products
        }
        for (; n; n--)
            sum += (int32_t)*value++ * $one;
$store
    }
}
""")
REQUANTIZE = """\
        sum >>= *shift++;
        if (sum > 32767)
            sum = 32767;
        if (sum < least)
            sum = least;
        *y++ = (int16_t)((sum * (int32_t)*multiplier++ + 16384) >> 15);"""
DEQUANTIZE = """\
        *y++ = (float)sum * *scale++;"""


def integer_call(node: Node, table: Table) -> tuple[str, list[object], dict[str, str]]:
    """Return the name of a node's function, its arguments after ``x`` and ``y``, and its source.

    :param table: writes the node's constant arrays
    :return: the source by the names of what it defines
    """
    size = int(np.prod(node.shape))
    if isinstance(node, Quantize):
        bound = f"{2 * node.most}.0f"
        return (
            "quantize",
            [size, table("twice", node.twice, "float"), bound],
            {"quantize": QUANTIZE},
        )
    if isinstance(node, Lookup):
        arguments = [size, table("table", node.table, "int16_t")]
        return "lookup", arguments, {"check": CHECK, "lookup": LOOKUP}
    assert isinstance(node, IntegerLinear)
    rows = node.weight
    active = [np.flatnonzero(row) for row in rows]
    bits = index_bits(rows.shape[1], max(map(len, active)))
    index = INDEX_TYPES[bits]
    arguments = [len(rows)]
    if dense := is_smaller_dense(rows, rows.itemsize, bits):
        arguments += [rows.shape[1], table("value", rows, "int8_t")]
    else:
        arguments += [
            table("length", [len(found) for found in active], index),
            table("column", np.concatenate(active), index),
            table("value", rows[rows != 0], "int8_t"),
        ]
    arguments.append(table("bias", node.bias, "int32_t"))
    name = node.op + ("_dense" if dense else f"_{bits}")
    if isinstance(node, Requantized):
        arguments += [
            table("multiplier", node.multiplier, "uint16_t"),
            table("shift", node.shift, "uint8_t"),
            0 if node.relu else -MOST,
        ]
        return name, arguments, {"check": CHECK, name: _linear(name, dense, index, True)}
    assert isinstance(node, Dequantized)
    arguments.append(table("scale", node.scale, "float"))
    return name, arguments, {name: _linear(name, dense, index, False)}


def _linear(name: str, dense: bool, index: str, hidden: bool) -> str:
    """Return the function of a linear layer.

    :param index: type of columns and lengths
    :param hidden: whether its results are whole numbers
    """
    inputs = "from[{}]" if dense else "x[column[{}]]"
    start = ["int32_t sum = *bias++;", f"uint32_t n = {'columns' if dense else '*length++'};"]
    parameters = ["const int16_t *x", f"{'int16_t' if hidden else 'float'} *y", "uint32_t rows"]
    if dense:
        start.append("const int16_t *from = x;")
        parameters.append("uint32_t columns")
    else:
        parameters += [f"const {index} *length", f"const {index} *column"]
    parameters += ["const int8_t *value", "const int32_t *bias"]
    if hidden:
        parameters += ["const uint16_t *multiplier", "const uint8_t *shift", "int32_t least"]
    else:
        parameters.append("const float *scale")
    lines = textwrap.wrap(
        ", ".join(parameter.replace(" ", "\xa0") for parameter in parameters),
        WIDTH,
        initial_indent=f"static void {name}(",
        subsequent_indent=" " * INDENT,
    )
    fields = {
        "signature": "\n".join(lines).replace("\xa0", " "),
        "start": "\n".join(f"        {line}" for line in start),
        "unrolled": UNROLLED,
        "at": "from" if dense else "column",
        "products": "\n".join(
            f"            sum += (int32_t)value[{i}] * {inputs.format(i)};" for i in range(UNROLLED)
        ),
        "one": "*from++" if dense else "x[*column++]",
        "store": REQUANTIZE if hidden else DEQUANTIZE,
    }
    return LINEAR.substitute(fields)
