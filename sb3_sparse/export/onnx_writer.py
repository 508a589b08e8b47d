"""Collects the nodes and constants of an ONNX model, activations included (opset 17)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np
from onnx import helper, numpy_helper

from sb3_sparse.export.nodes import Activation

OPERATORS = {
    "relu": "Relu",
    "leaky_relu": "LeakyRelu",
    "elu": "Elu",
    "exp": "Exp",
    "sqrt": "Sqrt",
    "tanh": "Tanh",
    "sigmoid": "Sigmoid",
    "softsign": "Softsign",
    "hardswish": "HardSwish",
}
"""Activations that are single ONNX operators."""
Do = Callable[..., str]
"""Appends an operator with values and constants as inputs; returns the name of its output."""

Formula = tuple[str | float, ...]
"""The last operator, and its inputs."""


class OnnxWriter:
    """Collects ONNX nodes and constants."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.arrays: list[Any] = []

    def node(self, kind: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Append a node and return the name of its output."""
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def array(self, values: Any, kind: type = np.float32) -> str:
        """Append a constant and return its name."""
        name = f"constant_{len(self.arrays)}"
        self.arrays.append(numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def activation(self, node: Activation, x: str, output: str) -> None:
        """Append an activation.

        :param x: name of its input
        :param output: name of its result
        """
        if node.kind in OPERATORS:
            alpha = {"alpha": node.parameters["slope"]} if "slope" in node.parameters else {}
            self.node(OPERATORS[node.kind], [x], output, **alpha)
            return
        steps = count(1)

        def named(inputs: Formula) -> list[str]:
            return [i if isinstance(i, str) else self.array(i) for i in inputs]

        def do(kind: str, *inputs: str | float) -> str:
            return self.node(kind, named(inputs), f"{output}_{next(steps)}")

        last, *inputs = FORMULAS[node.kind](do, x, **node.parameters)
        self.node(str(last), named(tuple(inputs)), output)


def _times_half_of_one_and(do: Do, x: str, part: str) -> Formula:
    return "Mul", do("Mul", x, 0.5), do("Add", part, 1.0)


def _gelu_tanh(do: Do, x: str) -> Formula:
    near = do("Clip", x, -10.0, 10.0)  # beyond, the result is the same, but the cube overflows
    cube = do("Mul", do("Mul", near, near), near)
    inner = do("Mul", do("Add", x, do("Mul", cube, 0.044715)), 0.7978845608028654)
    return _times_half_of_one_and(do, x, do("Tanh", inner))


def _softplus(do: Do, x: str, threshold: float) -> Formula:
    return "Where", do("Greater", x, threshold), x, do("Softplus", x)


def _softshrink(do: Do, x: str, most: float) -> Formula:
    return "Sub", x, do("Clip", x, -most, most)


def _hardshrink(do: Do, x: str, most: float) -> Formula:
    return "Where", do("LessOrEqual", do("Abs", x), most), 0.0, x


def _threshold(do: Do, x: str, most: float, instead: float) -> Formula:
    return "Where", do("LessOrEqual", x, most), instead, x


FORMULAS: dict[str, Callable[..., Formula]] = {
    "silu": lambda do, x: ("Mul", x, do("Sigmoid", x)),
    "gelu": lambda do, x: _times_half_of_one_and(do, x, do("Erf", do("Mul", x, 0.5**0.5))),
    "gelu_tanh": _gelu_tanh,
    "mish": lambda do, x: ("Mul", x, do("Tanh", do("Softplus", x))),
    "softplus": _softplus,
    "tanhshrink": lambda do, x: ("Sub", x, do("Tanh", x)),
    "softshrink": _softshrink,
    "hardshrink": _hardshrink,
    "threshold": _threshold,
}
"""Activations that take several operators."""
