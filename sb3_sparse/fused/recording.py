"""What a program consists of, and how a piece is added."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch as th
from torch import nn

from sb3_sparse.engine.activations import number_of
from sb3_sparse.fused.operations import Operation
from sb3_sparse.fused.values import Number, Value


@dataclass
class Slot:
    """A parameter, as one operation on parameters sees it.

    :param tensor: torch's
    :param layer: number of the layer whose weight it is; None: it is no weight
    :param optimizer: what moves it; None: it is not moved by one
    """

    tensor: th.Tensor
    layer: int | None
    optimizer: th.optim.Optimizer | None = None


@dataclass
class Minimised:
    """A loss that an optimizer makes less.

    :param optimizer: which
    :param slots: range of its parameters that have a gradient
    :param step: the operation in which the optimizer's step is taken
    :param captured: whether dense gradients are there at that step
    """

    optimizer: th.optim.Optimizer
    slots: tuple[int, int]
    step: Operation
    captured: bool


class Behind(NamedTuple):
    """What a value is the result of.

    :param layer: number of the linear layer
    :param x: its input
    :param activation: number and parameters of the activation within it
    """

    layer: int
    x: Value
    activation: tuple[int, float, float]


class Recording:
    """Operations, and what they work on.

    :param capture: optimizers whose layers' dense gradients are wanted too
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
        """What makes the results of layers."""
        self.parts: dict[Value, list[Value]] = {}
        """What values with joined features consist of."""
        self.turned: set[int] = set()
        """Layers whose values by columns are up to date."""
        self.needs: set[Value] = set()
        """Values whose gradient the loss at hand asks for."""

    def record(
        self, kind: str, to: Value | None, *operands: Value, features: int = 0, **others: Any
    ) -> Operation:
        """Append an operation; it runs on tiles if its result is batched."""
        if to is not None:
            features = to.features
            others.setdefault("tiled", to.batched)
        operation = Operation(kind, to, operands, features, **others)
        self.operations.append(operation)
        return operation

    def scalar(self, name: str) -> Value:
        """A number that each run is handed."""
        if name not in self.scalars:
            self.scalars[name] = Value(self, 1, False)
        return self.scalars[name]

    def constant(self, number: float) -> Value:
        """A number that stays."""
        if number not in self.constants:
            self.constants[number] = Value(self, 1, False)
        return self.constants[number]

    def value(self, number: Number) -> Value:
        """The value, or that of a number."""
        return number if isinstance(number, Value) else self.constant(float(number))

    def activated(self, x: Value, activation: nn.Module) -> Value:
        """An activation of ``x``; whoever asks for it knows its gradient."""
        made = Value(self, x.features, x.batched)
        kind, p, q = number_of(activation)
        self.record("ACTIVATION", made, x, number=kind, p=p, q=q)
        return made

    def slot(
        self, tensor: th.Tensor, layer: int | None, optimizer: th.optim.Optimizer | None = None
    ) -> int:
        """A row of the table of parameters; its number."""
        self.slots.append(Slot(tensor, layer, optimizer))
        return len(self.slots) - 1
