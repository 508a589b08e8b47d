"""The contents of a program, and the methods that add to them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch as th
from torch import nn

from sb3_sparse.engine.activations import number_of
from sb3_sparse.fused.operations import READ_SHARED, Operation
from sb3_sparse.fused.values import Number, Value


@dataclass
class Slot:
    """A parameter in the view of one operation.

    :param tensor: torch's tensor
    :param layer: number of the layer whose weight it is; None: it is not a weight
    :param optimizer: the optimizer that moves it; None: the operation is not a step
    """

    tensor: th.Tensor
    layer: int | None
    optimizer: th.optim.Optimizer | None = None


@dataclass
class Minimised:
    """A loss that an optimizer minimises.

    :param optimizer: the optimizer
    :param slots: range of its parameters that have a gradient
    :param step: the operation that takes the optimizer's step
    :param captured: whether dense gradients are available at that step
    """

    optimizer: th.optim.Optimizer
    slots: tuple[int, int]
    step: Operation
    captured: bool


class Behind(NamedTuple):
    """The operation that a value results from.

    :param layer: number of the linear layer
    :param x: input of the layer
    :param activation: number and parameters of its activation
    """

    layer: int
    x: Value
    activation: tuple[int, float, float]


class Recording:
    """Collects operations and their values, layers and parameters.

    :param capture: optimizers whose layers also need dense gradients
    """

    def __init__(self, capture: Iterable[th.optim.Optimizer] = ()) -> None:
        self.capture = list(map(id, capture))
        self.values: list[Value] = []
        self.operations: list[Operation] = []
        self.layers: list[nn.Linear] = []
        self.slots: list[Slot] = []
        self.scalars: dict[str, Value] = {}
        self.constants: dict[float, Value] = {}
        self.minimised: list[Minimised] = []
        self.vectors: dict[int, Value] = {}
        """Vectors of parameters by the id of their tensor."""
        self.behind: dict[Value, Behind] = {}
        """The layer behind each result of one."""
        self.parts: dict[Value, list[Value]] = {}
        """The parts of each concatenated value."""
        self.turned: set[int] = set()
        """Layers whose column-major values are up to date."""
        self.needs: set[Value] = set()
        """Values whose gradient the present loss needs."""

    def record(
        self, kind: str, to: Value | None, *operands: Value, features: int = 0, **others: Any
    ) -> Operation:
        """Append an operation, which runs on tiles if its result is batched."""
        if to is not None:
            features = to.features
            others.setdefault("tiled", to.batched)
        if others.get("tiled", True) and kind not in READ_SHARED:
            operands = tuple(x if x.batched else self._repeated(x) for x in operands)
        operation = Operation(kind, to, operands, features, **others)
        self.operations.append(operation)
        return operation

    def _repeated(self, x: Value) -> Value:
        """Give each entry of the batch its own copy of shared numbers."""
        made = Value(self, x.features, True)
        self.record("COPY", made, x)
        return made

    def scalar(self, name: str) -> Value:
        """Declare a number that each run sets."""
        if name not in self.scalars:
            self.scalars[name] = Value(self, 1, False)
        return self.scalars[name]

    def constant(self, number: float) -> Value:
        """Return a constant as a value."""
        if number not in self.constants:
            self.constants[number] = Value(self, 1, False)
        return self.constants[number]

    def value(self, number: Number) -> Value:
        """Convert a number to a value."""
        return number if isinstance(number, Value) else self.constant(float(number))

    def activated(self, x: Value, activation: nn.Module) -> Value:
        """Apply an activation to ``x``; the caller defines its gradient."""
        made = Value(self, x.features, x.batched)
        kind, p, q = number_of(activation)
        self.record("ACTIVATION", made, x, number=kind, p=p, q=q)
        return made

    def slot(
        self, tensor: th.Tensor, layer: int | None, optimizer: th.optim.Optimizer | None = None
    ) -> int:
        """Add a row to the table of parameters; return its number."""
        self.slots.append(Slot(tensor, layer, optimizer))
        return len(self.slots) - 1
