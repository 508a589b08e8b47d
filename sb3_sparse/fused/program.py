"""Programs: what one gradient step computes, written down once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch as th
from torch import nn

from sb3_sparse.engine.activations import number_of, tells_its_slope
from sb3_sparse.fused.descent import Descent
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.operations import Operation
from sb3_sparse.fused.values import Number, Value

NUMBERS = {"RELU": 1, "TANH": 2, "SIGMOID": 3, "SOFTPLUS": 11}
WITH_SLOPE_AT_INPUT = (nn.SiLU, nn.GELU)
RELU = NUMBERS["RELU"]
Parts = Sequence[tuple[nn.Linear, nn.Module | None]]


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


class Program:
    """Records operations. Losses are written with :class:`Value`, as they are with tensors.

    :param capture: optimizers whose layers' dense gradients are wanted too
    """

    def __init__(self, capture: Iterable[th.optim.Optimizer] = ()) -> None:
        self.capture = list(map(id, capture))
        self.values: list[Value] = []
        self.operations: list[Operation] = []
        self.layers: list[nn.Linear] = []
        self.slots: list[Slot] = []
        self.rows: list[tuple[str, int]] = []
        self.scalars: dict[str, Value] = {}
        self.constants: dict[float, Value] = {}
        self.logged: dict[str, Value] = {}
        self.minimised: list[Minimised] = []
        self.checks: dict[int, str] = {}
        self.marks: dict[str, Operation] = {}
        self._places: dict[int, int] = {}
        self.vectors: dict[int, Value] = {}
        """Vectors of parameters by the id of their tensor."""
        self.behind: dict[Value, Behind] = {}
        self._parts: dict[Value, list[Value]] = {}
        self.turned: set[int] = set()
        """Layers whose values by columns are up to date."""
        self.needs: set[Value] = set()
        """Values whose gradient the loss at hand asks for."""

    # What comes from outside

    def input(self, name: str, features: int) -> Value:
        """Rows ``[batch, features]`` that each run is handed; ask for a name once."""
        assert name not in dict(self.rows)
        value = Value(self, features, True)
        self.record("LOAD_ROWS", value, number=len(self.rows))
        self.rows.append((name, features))
        return value

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

    def parameter(self, tensor: th.Tensor) -> Value:
        """A vector of parameters outside of layers, as it is now."""
        value = Value(self, tensor.numel(), False)
        self.record("SPREAD", value, number=self.slot(tensor, None), tiled=False)
        self.vectors[id(tensor)] = value
        return value

    # Operations

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

    def activated(self, x: Value, name: str, p: float = 0.0, q: float = 0.0) -> Value:
        """An activation of ``x``; whoever asks for it knows its gradient."""
        made = Value(self, x.features, x.batched)
        self.record("ACTIVATION", made, x, number=NUMBERS[name], p=p, q=q)
        return made

    def joined(self, values: Sequence[Value]) -> Value:
        """Their features one after the other."""
        made = Value(self, sum(value.features for value in values), True)
        at, parents = 0, []
        for value in values:
            self.record("COPY", made.view(at, at + value.features), value)

            def back(g: Value, first: int = at, count: int = value.features) -> Value:
                return g.view(first - g.origin, first - g.origin + count)

            parents.append((value, back))
            at += value.features
        made.parents = tuple(parents)
        self._parts[made] = list(values)
        return made

    def network(self, parts: Parts, x: Value) -> Value:
        """Linear layers and their activations, one after the other.

        :raises NotCovered: for an activation that the kernels do not know
        """
        for module, activation in parts:
            x = self._linear(module, activation, x)
        return x

    def _linear(self, module: nn.Linear, activation: nn.Module | None, x: Value) -> Value:
        if module.in_features != x.features:
            raise NotCovered(f"a layer of {module.in_features} inputs gets {x.features}")
        layer = self._layer(module)
        y = Value(self, module.out_features, True)
        within = (0, 0.0, 0.0)
        if activation is not None and tells_its_slope(activation):
            within, activation = number_of(activation), None
        kind, p, q = within
        self.record("LINEAR", y, x, first=kind, p=p, q=q, number=layer)
        y.parents = ((x, lambda g: self._back_through(layer, x, g)),)
        self.behind[y] = Behind(layer, x, within)
        return y if activation is None else self._activation(activation, y)

    def _activation(self, module: nn.Module, z: Value) -> Value:
        if type(module) not in WITH_SLOPE_AT_INPUT:
            raise NotCovered(f"the activation {type(module).__name__}")
        kind, p, q = number_of(module)
        made = Value(self, z.features, True)
        self.record("ACTIVATION", made, z, number=kind, p=p, q=q)

        def back(g: Value) -> Value:
            sloped = Value(self, z.features, True)
            self.record("SLOPE_INPUT", sloped, g, z, number=kind)
            return sloped

        made.parents = ((z, back),)
        return made

    def _layer(self, module: nn.Linear) -> int:
        place = self._places.setdefault(id(module), len(self.layers))
        if place == len(self.layers):
            self.layers.append(module)
            self.record("PACK", None, number=self.slot(module.weight, place), tiled=False)
        return place

    def slot(
        self, tensor: th.Tensor, layer: int | None, optimizer: th.optim.Optimizer | None = None
    ) -> int:
        """A row of the table of parameters; its number."""
        self.slots.append(Slot(tensor, layer, optimizer))
        return len(self.slots) - 1

    def _back_through(self, layer: int, x: Value, g: Value) -> Value:
        """The gradient of a layer's input, for the features alone whose gradient is wanted."""
        if layer not in self.turned:
            self.turned.add(layer)
            self.record("TURN", None, number=layer, tiled=False, writes=(("turned", layer),))
        first, last = self._wanted(x)
        made = Value(self, last - first, True)
        made.origin = first
        operands = [g]
        if x in self.behind and self.behind[x].activation[0] == RELU:
            operands.append(x)
            made.gated = True
        self.record(
            "LINEAR_BACK", made, *operands, first=first, last=last, number=layer,
            reads=(("turned", layer),),
        )  # fmt: skip
        return made

    def _wanted(self, x: Value) -> tuple[int, int]:
        parts = self._parts.get(x)
        if parts is None:
            return 0, x.features
        ends = [0]
        for part in parts:
            ends.append(ends[-1] + part.features)
        wanted = [i for i, part in enumerate(parts) if part in self.needs]
        return ends[wanted[0]], ends[wanted[-1] + 1]

    # Learning

    def log(self, name: str, value: Value) -> None:
        """Let each run tell the value of one number."""
        self.logged[name] = value

    def mark(self, name: str) -> None:
        """Name the place behind the last optimizer's step, for runs that end or begin there."""
        self.marks[name] = self.minimised[-1].step

    def check(self, value: Value, what: str) -> None:
        """End a run before anything else changes if there is a NaN in it."""
        operation = self.record("CHECK", None, value, features=value.features, tiled=False)
        self.checks[id(operation)] = what

    def minimise(
        self, loss: Value, optimizer: th.optim.Optimizer, clip: Value | None = None
    ) -> None:
        """Take a step of an optimizer down the gradient of a loss.

        :param loss: one number
        :param optimizer: moves those of its parameters that the loss depends on
        :param clip: greatest norm of their gradient
        :raises NotCovered: if the loss uses a layer twice
        """
        Descent(self, optimizer).record(loss, clip)

    def finish_step(
        self,
        optimizer: th.optim.Optimizer,
        slots: tuple[int, int],
        step: Operation,
        captured: bool,
    ) -> None:
        """Note that an optimizer takes a step."""
        self.minimised.append(Minimised(optimizer, slots, step, captured))

    def follow(self, network: Parts, target_network: Parts, tau: Value) -> None:
        """Let a target network follow by Polyak averaging.

        :param tau: share of the network
        """
        for (online, _), (target, _) in zip(network, target_network, strict=True):
            numbers = [self._layer(online), self._layer(target)]
            tensors: list[tuple[th.Tensor | None, th.Tensor | None, bool]] = [
                (online.weight, target.weight, True), (online.bias, target.bias, False)
            ]  # fmt: skip
            for one, two, weight in tensors:
                if one is None or two is None:
                    continue
                first, last = (
                    self.slot(tensor, number if weight else None)
                    for tensor, number in zip((one, two), numbers, strict=True)
                )
                self.record("POLYAK", None, tau, first=first, last=last, tiled=False, changes=True)
