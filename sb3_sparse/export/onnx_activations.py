"""Activations as ONNX operators, all of opset 17."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from sb3_sparse.export.nodes import Activation


class Writer(Protocol):
    """What appends ONNX nodes and constants."""

    def node(self, kind: str, inputs: list[str], output: str, **attributes: float) -> str:
        """Append an ONNX node; the name of its output."""

    def array(self, values: float) -> str:
        """Append a constant; its name."""


OPERATORS = {
    "relu": "Relu",
    "leaky_relu": "LeakyRelu",
    "elu": "Elu",
    "tanh": "Tanh",
    "sigmoid": "Sigmoid",
    "softsign": "Softsign",
    "hardswish": "HardSwish",
}
"""Those that ONNX has, too."""


def write_activation(writer: Writer, node: Activation, x: str, output: str) -> None:
    """Append what computes an activation.

    :param x: name of its input
    :param output: name of its result
    """
    if node.kind in OPERATORS:
        alpha = {"alpha": node.parameters["slope"]} if "slope" in node.parameters else {}
        writer.node(OPERATORS[node.kind], [x], output, **alpha)
        return
    _Composed(writer, x, output).write(node)


class _Composed:
    """Writes an activation out of several operators."""

    def __init__(self, writer: Writer, x: str, output: str) -> None:
        self.writer = writer
        self.x = x
        self.output = output
        self.count = 0

    def write(self, node: Activation) -> None:
        last, *inputs = FORMULAS[node.kind](self, self.x, **node.parameters)
        self.writer.node(last, inputs, self.output)

    def __call__(self, kind: str, *inputs: str | float) -> str:
        """The name of what an operator gives for values and constants."""
        names = [self.writer.array(i) if isinstance(i, (int, float)) else i for i in inputs]
        self.count += 1
        return self.writer.node(kind, names, f"{self.output}_{self.count}")

    def constant(self, value: float) -> str:
        """The name of a constant."""
        return self.writer.array(value)


def _times_half_of_one_and(do: _Composed, x: str, part: str) -> tuple[str, ...]:
    return "Mul", do("Mul", x, 0.5), do("Add", part, 1.0)


def _gelu_tanh(do: _Composed, x: str) -> tuple[str, ...]:
    near = do("Clip", x, -10.0, 10.0)  # what is beyond does not count, and its cube has no end
    cube = do("Mul", do("Mul", near, near), near)
    inner = do("Mul", do("Add", x, do("Mul", cube, 0.044715)), 0.7978845608028654)
    return _times_half_of_one_and(do, x, do("Tanh", inner))


def _softplus(do: _Composed, x: str, threshold: float) -> tuple[str, ...]:
    return "Where", do("Greater", x, threshold), x, do("Softplus", x)


def _softshrink(do: _Composed, x: str, most: float) -> tuple[str, ...]:
    return "Sub", x, do("Clip", x, -most, most)


def _hardshrink(do: _Composed, x: str, most: float) -> tuple[str, ...]:
    return "Where", do("LessOrEqual", do("Abs", x), most), do.constant(0.0), x


def _threshold(do: _Composed, x: str, most: float, instead: float) -> tuple[str, ...]:
    return "Where", do("LessOrEqual", x, most), do.constant(instead), x


FORMULAS: dict[str, Callable[..., tuple[str, ...]]] = {
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
"""The last operator of each, and the names of its inputs."""
