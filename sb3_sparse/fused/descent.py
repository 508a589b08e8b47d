"""Records the gradient of a loss and the optimizer's step: reverse-mode differentiation."""

from __future__ import annotations

from typing import Any

import torch as th

from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.recording import Behind, Minimised, Recording
from sb3_sparse.fused.values import Value


class Descent:
    """Records the gradients for one step of an optimizer, and the step.

    :param program: the program that records them
    :param optimizer: moves those of its parameters that the loss depends on
    """

    def __init__(self, program: Recording, optimizer: th.optim.Optimizer) -> None:
        self._program = program
        self._optimizer = optimizer
        self._captured = id(optimizer) in program.capture
        self._wanted = {id(p): p for group in optimizer.param_groups for p in group["params"]}
        self._grads: dict[Value, Value] = {}
        self._layers: list[int] = []

    def record(self, loss: Value, clip: Value | None) -> None:
        """Record the gradients, their clipping and the step.

        :param loss: a single number
        :param clip: maximum norm of the gradient; None: no clipping
        """
        program = self._program
        before = program.values[:]
        program.needs = self._depending(before)
        self._grads = {loss: program.constant(1.0)}
        begin = len(program.slots)
        for value in reversed(before):
            if value in self._grads and value in program.needs:
                self._pass_on(value, self._grads[value])
        self._export()
        self._finish((begin, len(program.slots)), clip)

    def _depending(self, values: list[Value]) -> set[Value]:
        """Find the values that depend on the optimizer's parameters."""
        program = self._program
        found = {value for key, value in program.vectors.items() if key in self._wanted}
        for value in values:
            behind = program.behind.get(value)
            if (behind is not None and self._moves(behind.layer)) or any(
                parent in found for parent, _ in value.parents
            ):
                found.add(value)
        return found

    def _moves(self, layer: int) -> bool:
        return id(self._program.layers[layer].weight) in self._wanted

    def _pass_on(self, value: Value, g: Value) -> None:
        behind = self._program.behind.get(value)
        if behind is not None:
            g = self._sloped(g, value, behind)
            if self._moves(behind.layer):
                self._record_grads(behind, g)
        for parent, back in value.parents:
            if parent in self._program.needs:
                self._add(parent, back(g))

    def _sloped(self, g: Value, y: Value, behind: Behind) -> Value:
        kind, p, q = behind.activation
        if not kind or g.gated:
            return g
        made = Value(self._program, y.features, True)
        self._program.record("SLOPE_RESULT", made, g, y, number=kind, p=p, q=q)
        return made

    def _record_grads(self, behind: Behind, g: Value) -> None:
        program, layer = self._program, behind.layer
        module = program.layers[layer]
        again = layer in self._layers
        if not again:
            slots = program.slots
            if any(s.tensor is module.weight and s.optimizer is self._optimizer for s in slots):
                raise NotCovered("weights that two layers share, or that an optimizer moves twice")
            program.slot(module.weight, layer, self._optimizer)
            if module.bias is not None:
                program.slot(module.bias, None, self._optimizer)
            self._layers.append(layer)
        own = ("gradient", layer, id(self._optimizer))
        for kind in ["LINEAR_GRAD"] + ["LINEAR_DENSE_GRAD"] * self._captured:
            program.record(
                kind, None, g, behind.x, first=int(again), number=layer, tiled=True,
                reads=(own,) * again, writes=(own, *self._all),
            )  # fmt: skip

    @property
    def _all(self) -> tuple[Any, ...]:
        return (("gradients", id(self._optimizer)),)

    def _add(self, parent: Value, g: Value) -> None:
        """Add to a parent's gradient, summed over the dimensions to which it was broadcast."""
        if g.features > parent.features:
            g = g.sum_features()
        elif g.features < parent.features and g.origin is None:
            spread = Value(self._program, parent.features, g.batched)
            self._program.record("COPY", spread, g)
            g = spread
        if g.batched and not parent.batched:
            g = g.sum()
        one = self._grads.get(parent)
        if one is not None:
            if one.origin != g.origin:
                one, g = (parent.whole(x) for x in (one, g))
            total = one + g
            total.gated, total.origin = g.gated and one.gated, g.origin
            g = total
        self._grads[parent] = g

    def _export(self) -> None:
        """Move gradients of parameter vectors to where the optimizer reads them."""
        program = self._program
        for key, value in program.vectors.items():
            if key in self._wanted and value in self._grads:
                number = program.slot(self._wanted[key], None, self._optimizer)
                program.record(
                    "EXPORT", None, self._grads[value], features=value.features, number=number,
                    tiled=False, writes=self._all,
                )  # fmt: skip

    def _finish(self, slots: tuple[int, int], clip: Value | None) -> None:
        program = self._program
        common: dict[str, Any] = {
            "first": slots[0], "last": slots[1], "tiled": False,
            "reads": self._all, "writes": self._all,
        }  # fmt: skip
        program.record("MASK_GRADS", None, **common)
        if clip is not None:
            program.record("CLIP_NORM", Value(program, 1, False), clip, **common)
        step = program.record("OPTIMIZE", None, **common, changes=True)
        program.minimised.append(Minimised(self._optimizer, slots, step, self._captured))
        # A later loss must read them again.
        program.turned.difference_update(self._layers)
        for key in self._wanted:
            program.vectors.pop(key, None)
