"""Programs: the operations of one gradient step, recorded once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch as th
from torch import nn

from sb3_sparse.engine.activations import number_of, tells_its_slope
from sb3_sparse.engine.paths import Part
from sb3_sparse.fused.batch_renorm import Statistics, by_running_statistics, renormalised
from sb3_sparse.fused.descent import Descent
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.operations import Operation
from sb3_sparse.fused.recording import Behind, Recording
from sb3_sparse.fused.values import Value

WITH_SLOPE_AT_INPUT = (nn.SiLU, nn.GELU)
RELU, _, _ = number_of(nn.ReLU())
Parts = Sequence[Part]


class Program(Recording):
    """Records a gradient step; write losses with :class:`Value` as with tensors.

    Example::

        from sb3_sparse.fused import Program

        program = Program()
        error = program.input("targets", 1) - program.input("predictions", 1)
        program.log("loss", error.square().mean())

    :param capture: optimizers whose layers also need dense gradients
    """

    def __init__(self, capture: Iterable[th.optim.Optimizer] = ()) -> None:
        super().__init__(capture)
        self.rows: list[tuple[str, int]] = []
        self.logged: dict[str, Value] = {}
        self.checks: dict[int, str] = {}
        self.marks: dict[str, Operation] = {}
        self.statistics: dict[Any, Statistics] = {}
        """Next running statistics of norms, until :meth:`minimise` stores them."""
        self.counters: list[tuple[Operation, th.Tensor]] = []
        """Counters of the batches that norms have seen, each with the operation that it counts."""
        self._places: dict[int, int] = {}

    # Inputs

    def input(self, name: str, features: int) -> Value:
        """Declare an input ``[batch, features]`` of each run, once for each name."""
        assert name not in dict(self.rows)
        value = Value(self, features, True)
        self.record("LOAD_ROWS", value, number=len(self.rows))
        self.rows.append((name, features))
        return value

    def parameter(self, tensor: th.Tensor) -> Value:
        """Read a vector of parameters that is not part of a layer."""
        if id(tensor) in self.vectors:
            return self.vectors[id(tensor)]
        value = Value(self, tensor.numel(), False)
        self.record("SPREAD", value, number=self.slot(tensor, None), tiled=False)
        self.vectors[id(tensor)] = value
        return value

    # Operations

    def joined(self, values: Sequence[Value]) -> Value:
        """Concatenate the features of some values."""
        made = Value(self, sum(value.features for value in values), True)
        at, parents = 0, []
        for value in values:
            self.record("COPY", made.view(at, at + value.features), value)

            def back(g: Value, first: int = at, count: int = value.features) -> Value:
                first -= g.origin or 0
                return g.view(first, first + count)

            parents.append((value, back))
            at += value.features
        made.parents = tuple(parents)
        self.parts[made] = list(values)
        return made

    def network(self, parts: Parts, x: Value) -> Value:
        """Apply linear layers, their norms, activations and shortcuts in turn.

        A BatchRenorm normalises by its running statistics.

        Example::

            from torch import nn
            from sb3_sparse.fused import Program, parts

            program = Program()
            layers = parts(nn.Linear(3, 8), nn.ReLU(), nn.Linear(8, 2))
            program.network(layers, program.input("obs", 3)).features  # 2

        :param parts: the network, from :func:`parts`
        :param x: ``[batch, features]``, as many features as the network has inputs
        :return: ``[batch, outputs]``
        :raises NotCovered: for a module that the kernels do not know
        """
        return self._apply(parts, [x], trains=False)[0]

    def training_network(self, parts: Parts, *batches: Value) -> list[Value]:
        """Apply a network to one batch or two at once, its BatchRenorms in training mode.

        They normalise by the mean and variance of all these entries. Their running statistics and
        their counter of batches move in the next :meth:`minimise`, without which no program runs.

        Example::

            from sb3_sparse import CrossQ
            from sb3_sparse.fused import Program, parts

            critic = CrossQ("SparsePolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.9)).critic
            program = Program()
            now, later = program.input("now", 4), program.input("later", 4)
            layers = parts(critic.q_networks[0])
            value, next_value = program.training_network(layers, now, later)
            program.minimise((value - next_value.detach()).square().mean(), critic.optimizer)

        :param parts: the network, from :func:`parts`
        :param batches: one or two of ``[batch, features]``
        :return: a list of the result of each batch, ``[batch, outputs]``
        :raises ValueError: for another number of batches
        :raises NotCovered: as :meth:`network`; for a BatchRenorm that is in training mode twice
            before a :meth:`minimise`
        """
        if not 1 <= len(batches) <= 2:
            raise ValueError(f"training_network takes one batch or two, not {len(batches)}")
        return self._apply(parts, list(batches), trains=True)

    def _apply(self, parts: Parts, batches: list[Value], trains: bool) -> list[Value]:
        results = [batches]
        for layer, activation, norm, shortcut in parts:
            if isinstance(norm, nn.LayerNorm):
                batches = [self._layer_norm(norm, x) for x in batches]
            elif norm in self.statistics:
                raise NotCovered("a BatchRenorm that is used again before its statistics move")
            elif norm is not None and trains:
                batches, self.statistics[norm] = renormalised(norm, batches)
            elif norm is not None:
                batches = [by_running_statistics(norm, x) for x in batches]
            if layer is not None:
                batches = [self._linear(layer, activation, x) for x in batches]
            if shortcut is not None:
                batches = [x + y for x, y in zip(batches, results[shortcut + 1], strict=True)]
            results.append(batches)
        return batches

    def _layer_norm(self, norm: nn.LayerNorm, x: Value) -> Value:
        if norm.normalized_shape != (x.features,):
            raise NotCovered(f"a LayerNorm of {norm.normalized_shape} features gets {x.features}")
        y = x.layer_norm(norm.eps)
        if norm.weight is not None:
            y = y * self.parameter(norm.weight)
        return y if norm.bias is None else y + self.parameter(norm.bias)

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
        made = self.activated(z, module)

        def back(g: Value) -> Value:
            sloped = Value(self, z.features, True)
            self.record("SLOPE_INPUT", sloped, g, z, number=number_of(module)[0])
            return sloped

        made.parents = ((z, back),)
        return made

    def _layer(self, module: nn.Linear) -> int:
        place = self._places.setdefault(id(module), len(self.layers))
        if place == len(self.layers):
            self.layers.append(module)
            self.record("PACK", None, number=self.slot(module.weight, place), tiled=False)
        return place

    def _back_through(self, layer: int, x: Value, g: Value) -> Value:
        """Record the gradient of a layer's input, for the features that need it."""
        if layer not in self.turned:
            self.turned.add(layer)
            self.record("TURN", None, number=layer, tiled=False, writes=(("turned", layer),))
        first, last = self._wanted(x)
        made = Value(self, last - first, True)
        if made.features < x.features:
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
        parts = self.parts.get(x)
        if parts is None:
            return 0, x.features
        ends = [0]
        for part in parts:
            ends.append(ends[-1] + part.features)
        wanted = [i for i, part in enumerate(parts) if part in self.needs]
        return ends[wanted[0]], ends[wanted[-1] + 1]

    # Training

    def log(self, name: str, value: Value) -> None:
        """Make a number readable after each run."""
        self.logged[name] = value

    def mark(self, name: str) -> None:
        """Name the position after the last optimizer step, where runs may end or begin."""
        self.marks[name] = self.minimised[-1].step

    def check(self, value: Value, what: str) -> None:
        """Stop a run if the value has a NaN.

        :param what: name of the check
        """
        operation = self.record("CHECK", None, value, features=value.features, tiled=False)
        self.checks[id(operation)] = what

    def minimise(
        self, loss: Value, optimizer: th.optim.Optimizer, clip: Value | None = None
    ) -> None:
        """Differentiate a loss and take a step of an optimizer.

        :param loss: a single number
        :param optimizer: moves those of its parameters that the loss depends on
        :param clip: maximum norm of their gradient; None: no clipping
        :raises NotCovered: if the optimizer has moved one of its layers before
        """
        self._store_statistics()
        Descent(self, optimizer).record(loss, clip)

    def _store_statistics(self) -> None:
        """Move the running statistics of norms that have seen batches."""
        for norm, statistics in self.statistics.items():
            for tensor, value in statistics:
                stored = self.record(
                    "STORE", None, value, features=value.features, number=self.slot(tensor, None),
                    tiled=False, changes=True,
                )  # fmt: skip
                self.vectors.pop(id(tensor), None)  # a later norm must read it again
            self.counters.append((stored, norm.steps))
        self.statistics.clear()

    def polyak_update(self, network: Parts, target_network: Parts, tau: Value) -> None:
        """Update a target network by Polyak averaging.

        :param tau: weight of the online network
        """
        for online, target in zip(network, target_network, strict=True):
            for one, two in zip(self._slots_of(online), self._slots_of(target), strict=True):
                self.record("POLYAK", None, tau, first=one, last=two, tiled=False, changes=True)

    def _slots_of(self, part: Part) -> list[int]:
        """Add each parameter of a part to the table; return their numbers."""
        numbers = []
        if part.layer is not None:
            numbers.append(self.slot(part.layer.weight, self._layer(part.layer)))
        vectors = [] if part.layer is None else [part.layer.bias]
        if isinstance(part.norm, nn.LayerNorm):
            vectors += [part.norm.bias, part.norm.weight]
        elif part.norm is not None:
            raise NotCovered(f"a target with a {type(part.norm).__name__}")
        return numbers + [self.slot(vector, None) for vector in vectors if vector is not None]
