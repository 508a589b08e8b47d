"""The operations that an exported policy is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.numpy_policy import OPERATIONS

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Node:
    """An operation.

    :param inputs: values that it reads: 0 is the observation, ``i`` the result of node ``i - 1``
    :param shape: result for one observation: ``(units,)`` or ``(units, height, width)``
    """

    inputs: tuple[int, ...]
    shape: tuple[int, ...]
    op: ClassVar[str]
    whole: ClassVar[bool] = False
    """Whether the result is 16-bit whole numbers."""

    @property
    def nnz(self) -> int:
        """Number of connections that are not 0."""
        return 0

    @property
    def name(self) -> str:
        """The NumPy loader's name of the operation."""
        return self.op

    def fields(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that the NumPy loader reads; the last axis is the batch."""
        return {}

    def run(self, *inputs: NDArray[Any]) -> NDArray[Any]:
        """Compute the result for inputs whose last axis is the batch."""
        operation: Any = OPERATIONS[self.name]
        result: NDArray[Any] = operation(self.fields(), *inputs)
        return result


@dataclass(frozen=True, eq=False)
class Normalize(Node):
    """``clip((x - mean) * scale)``; two floats hold each mean, which may far exceed ``x - mean``.

    :param mean: float64, shape of the input
    :param scale: float64, one over the standard deviation
    :param clip: largest absolute value
    """

    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    clip: float
    op = "normalize"

    def fields(self) -> dict[str, NDArray[Any]]:
        mean = self.mean.astype(np.float32)
        return {
            "mean": mean[..., None],
            "rest": (self.mean - mean).astype(np.float32)[..., None],
            "scale": self.scale.astype(np.float32)[..., None],
            "clip": np.array([-self.clip, self.clip], np.float32),
        }


@dataclass(frozen=True, eq=False)
class PerUnit(Node):
    """An operation with its own numbers for each unit; all fields have shape ``(units,)``."""

    names: ClassVar[tuple[str, ...]]

    def fields(self) -> dict[str, NDArray[Any]]:
        per_unit = (self.shape[0], *[1] * len(self.shape))
        return {name: getattr(self, name).reshape(per_unit) for name in self.names}


@dataclass(frozen=True, eq=False)
class Affine(PerUnit):
    """``x * scale + shift``."""

    scale: Floats
    shift: Floats
    op = "affine"
    names = ("scale", "shift")


@dataclass(frozen=True, eq=False)
class Clip(PerUnit):
    """``x`` clipped to ``[low, high]``."""

    low: Floats
    high: Floats
    op = "clip"
    names = ("low", "high")


@dataclass(frozen=True, eq=False)
class Slopes(PerUnit):
    """``x * slope`` for negative ``x``, else ``x``: a PReLU with a slope for each unit."""

    slope: Floats
    op = "slopes"
    names = ("slope",)

    @property
    def name(self) -> str:
        return "leaky_relu"


@dataclass(frozen=True, eq=False)
class Activation(Node):
    """An elementwise function.

    :param kind: the NumPy loader's name of the function
    :param parameters: the function's parameters by name
    """

    kind: str
    parameters: Mapping[str, float] = field(default_factory=dict)
    op = "activation"

    @property
    def name(self) -> str:
        return self.kind

    def fields(self) -> dict[str, NDArray[Any]]:
        return {name: np.array(value, np.float32) for name, value in self.parameters.items()}


@dataclass(frozen=True, eq=False)
class Weighted(Node):
    """A layer with connections.

    :param weight: shape ``(outputs, inputs)`` or ``(outputs, inputs, height, width)``
    :param bias: shape ``(outputs,)``
    """

    weight: Floats
    bias: Floats

    @property
    def rows(self) -> Floats:
        """The weight with a row for each output."""
        return self.weight.reshape(len(self.weight), -1)

    @property
    def nnz(self) -> int:
        """Number of connections that are not 0."""
        return int(np.count_nonzero(self.weight))

    def fields(self) -> dict[str, NDArray[Any]]:
        return {"weight": self.rows, "bias": self.bias[:, None]}


class Linear(Weighted):
    """``weight @ x + bias``."""

    op = "linear"


@dataclass(frozen=True, eq=False)
class Conv(Weighted):
    """A convolution over height and width, padded with zeros.

    :param stride: vertical and horizontal steps
    :param padding: vertical and horizontal padding on each side
    """

    stride: tuple[int, int]
    padding: tuple[int, int]
    op = "conv"

    def fields(self) -> dict[str, NDArray[Any]]:
        return {
            **super().fields(),
            "kernel": np.array(self.weight.shape[2:]),
            "stride": np.array(self.stride),
            "padding": np.array(self.padding),
        }


@dataclass(frozen=True, eq=False)
class MaxPool(Node):
    """The largest of each window."""

    kernel: tuple[int, int]
    stride: tuple[int, int]
    padding: tuple[int, int]
    op = "max_pool"

    def fields(self) -> dict[str, NDArray[Any]]:
        return {name: np.array(getattr(self, name)) for name in ("kernel", "stride", "padding")}


class Flatten(Node):
    """All units and places as one vector."""

    op = "flatten"


class Pairwise(Node):
    """An operation on two values, element by element."""


class Add(Pairwise):
    """The sum of two values."""

    op = "add"


class Multiply(Pairwise):
    """The product of two values."""

    op = "multiply"


class Concat(Node):
    """The concatenation of values along the units."""

    op = "concat"


@dataclass(frozen=True, eq=False)
class Standardize(Node):
    """All units minus their mean, divided by their standard deviation: layer normalisation.

    :param eps: added to the variance
    """

    eps: float
    op = "standardize"

    def fields(self) -> dict[str, NDArray[Any]]:
        return {"eps": np.array(self.eps, np.float32)}


@dataclass(frozen=True, eq=False)
class Slice(Node):
    """A part of the observation.

    :param start: index of the part's first element
    """

    start: int
    op = "slice"

    def fields(self) -> dict[str, NDArray[Any]]:
        stop = self.start + int(np.prod(self.shape))
        return {"range": np.array([self.start, stop]), "shape": np.array(self.shape)}


@dataclass(frozen=True, eq=False)
class OneHot(Node):
    """One-hot encodings of whole numbers, concatenated.

    :param sizes: number of values of each number
    """

    sizes: tuple[int, ...]
    op = "one_hot"

    def fields(self) -> dict[str, NDArray[Any]]:
        values = np.concatenate([np.arange(size) for size in self.sizes])
        return {"sizes": np.array(self.sizes), "values": values.astype(np.float32)[:, None]}


@dataclass(frozen=True, eq=False)
class Argmax(Node):
    """The index of the largest unit in each group of consecutive units; the first among equals.

    :param sizes: number of units of each group
    """

    sizes: tuple[int, ...]
    op = "argmax"

    def fields(self) -> dict[str, NDArray[Any]]:
        return {"splits": np.cumsum(self.sizes)[:-1]}


class Positive(Node):
    """1 for positive units, 0 for others."""

    op = "positive"
