"""Values of a program, in terms of which losses are written."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, Union

from torch import nn

Number = Union["Value", float]
Back = Callable[["Value"], "Value"]
"""Gives the gradient of a parent from the gradient of a value."""


class Recorder(Protocol):
    """The view of a program that its values have."""

    values: list[Value]

    def record(self, kind: str, to: Value | None, *operands: Value, **others: Any) -> Any:
        """Append an operation."""

    def scalar(self, name: str) -> Value:
        """Declare a number that each run sets."""

    def constant(self, number: float) -> Value:
        """Return a constant as a value."""

    def value(self, number: Number) -> Value:
        """Convert a number to a value."""

    def activated(self, x: Value, activation: nn.Module) -> Value:
        """Apply an activation to ``x``."""


class Value:
    """Numbers ``[batch, features]`` of a program, or ``[features]`` that the whole batch shares.

    Arithmetic records operations and gives new values. A single feature is broadcast to any number
    of features.

    Example::

        from sb3_sparse.fused import Program

        q = Program().input("q", 4)
        loss = (q.max_features() - 1.0).huber().mean()
        loss.features, loss.batched  # (1, False)

    :param program: the program that records
    :param features: number of features
    :param batched: whether each entry of the batch has its own numbers
    :param parents: the values that it was computed from, each with its gradient
    """

    def __init__(
        self,
        program: Recorder,
        features: int,
        batched: bool,
        parents: tuple[tuple[Value, Back], ...] = (),
    ) -> None:
        self.program = program
        self.features = features
        self.batched = batched
        self.parents = parents
        self.root = self
        self.offset = 0
        self.origin: int | None = None
        """First feature that a gradient covers; None: it covers all, or 1 is broadcast to them."""
        self.gated = False
        """Whether a gradient is already 0 where the ReLU before it is."""
        program.values.append(self)

    def view(self, first: int, last: int) -> Value:
        """View features ``first`` to ``last``, without a copy or a gradient."""
        found = Value(self.program, last - first, self.batched)
        found.root, found.offset = self.root, self.offset + first
        return found

    def detach(self) -> Value:
        """Return the same numbers without a gradient."""
        return self.view(0, self.features)

    def __getitem__(self, part: slice) -> Value:
        first, last, _ = part.indices(self.features)
        found = self.view(first, last)
        found.parents = ((self, lambda g: self._embedded(g, first, last)),)
        return found

    def whole(self, g: Value) -> Value:
        """Complete a gradient that covers only some features of this value by zeros."""
        return g if g.origin is None else self._embedded(g, g.origin, g.origin + g.features)

    def _embedded(self, g: Value, first: int, last: int) -> Value:
        whole = Value(self.program, self.features, self.batched)
        self.program.record("COPY", whole, self.program.constant(0.0))
        self.program.record("COPY", whole.view(first, last), g)
        return whole

    # Arithmetic

    def _made(self, kind: str, *others: Number, back: tuple[Back, ...] = ()) -> Value:
        operands = (self, *map(self.program.value, others))
        parents = tuple(zip(operands, back, strict=False))
        features = max(value.features for value in operands)
        batched = any(value.batched for value in operands)
        made = Value(self.program, features, batched, parents)
        self.program.record(kind, made, *operands)
        return made

    def __add__(self, other: Number) -> Value:
        return self._made("ADD", other, back=(lambda g: g, lambda g: g))

    def __sub__(self, other: Number) -> Value:
        return self._made("SUBTRACT", other, back=(lambda g: g, lambda g: -g))

    def __mul__(self, other: Number) -> Value:
        other = self.program.value(other)
        return self._made("MULTIPLY", other, back=(lambda g: g * other, lambda g: g * self))

    def __truediv__(self, other: Number) -> Value:
        other = self.program.value(other)
        made = self._made("DIVIDE", other)
        made.parents = ((self, lambda g: g / other), (other, lambda g: -(g * made / other)))
        return made

    def __neg__(self) -> Value:
        return self * -1.0

    def __radd__(self, other: float) -> Value:
        return self + other

    def __rsub__(self, other: float) -> Value:
        return self.program.value(other) - self

    def __rmul__(self, other: float) -> Value:
        return self * other

    # Comparisons: 1.0 where they hold, else 0.0

    def less(self, other: Number) -> Value:
        """Compare: 1.0 where less than ``other``."""
        return self._made("LESS", other)

    def same(self, other: Number) -> Value:
        """Compare: 1.0 where equal to ``other``."""
        return self._made("SAME", other)

    def first_least(self, other: Value) -> Value:
        """Compute the minimum; of equal values the first gets the gradient."""
        return self._made(
            "LEAST",
            other,
            back=(lambda g: g * (1.0 - other.less(self)), lambda g: g * other.less(self)),
        )

    def least(self, other: Value) -> Value:
        """Compute the minimum; equal values get half of the gradient each."""

        def back(one: Value, two: Value) -> Back:
            return lambda g: g * (one.less(two) + one.same(two) * 0.5)

        return self._made("LEAST", other, back=(back(self, other), back(other, self)))

    def clamp(self, least: Number, most: Number) -> Value:
        """Clamp to bounds; the gradient is 0 beyond them."""
        return self._made(
            "CLAMP", least, most, back=(lambda g: g * self._made("INSIDE", least, most),)
        )

    # Functions

    def exp(self) -> Value:
        """Compute ``e^x``."""
        made = self._made("EXP")
        made.parents = ((self, lambda g: g * made),)
        return made

    def log(self) -> Value:
        """Compute the natural logarithm."""
        return self._made("LOG", back=(lambda g: g / self,))

    def sqrt(self) -> Value:
        """Compute the square root."""
        made = self._made("SQRT")
        made.parents = ((self, lambda g: g * 0.5 / made),)
        return made

    def abs(self) -> Value:
        """Compute the magnitude, without a gradient."""
        return self._made("ABS")

    def square(self) -> Value:
        """Compute the square."""
        return self._made("MULTIPLY", self, back=(lambda g: g * (self * 2.0),))

    def huber(self) -> Value:
        """Compute the smooth L1 loss: half the square up to 1, then linear."""
        return self._made("HUBER", back=(lambda g: g * self.clamp(-1.0, 1.0),))

    def tanh(self) -> Value:
        """Compute the hyperbolic tangent."""
        made = self.program.activated(self, nn.Tanh())
        made.parents = ((self, lambda g: g * (1.0 - made.square())),)
        return made

    def sigmoid(self) -> Value:
        """Compute ``1 / (1 + e^-x)``."""
        made = self.program.activated(self, nn.Sigmoid())
        made.parents = ((self, lambda g: g * (made * (1.0 - made))),)
        return made

    def softplus(self) -> Value:
        """Compute ``log(1 + e^x)``."""
        made = self.program.activated(self, nn.Softplus())
        made.parents = ((self, lambda g: g * self.sigmoid()),)
        return made

    # Sums

    def sum_features(self) -> Value:
        """Sum over features."""
        made = Value(self.program, 1, self.batched, ((self, lambda g: g),))
        self.program.record("SUM_FEATURES", made, self, first=self.features)
        return made

    def layer_norm(self, epsilon: float) -> Value:
        """Shift and scale each entry's features to mean 0 and variance 1.

        :param epsilon: added to the variance
        """
        share = 1.0 / self.features
        x = self.detach()
        centred = x - x.sum_features() * share
        deviation = (centred.square().sum_features() * share + epsilon).sqrt()
        made = centred / deviation

        def back(g: Value) -> Value:
            along = made * ((g * made).sum_features() * share)
            return (g - g.sum_features() * share - along) / deviation

        made.parents = ((self, back),)
        return made

    def blocks_of(self, size: int) -> int:
        """Return the number of blocks of ``size`` features.

        :raises ValueError: if the features cannot be divided into such blocks
        """
        if size < 1 or self.features % size:
            raise ValueError(f"{self.features} features cannot be divided into blocks of {size}")
        return self.features // size

    def max_features(self) -> Value:
        """Compute the maximum over features, without a gradient."""
        made = Value(self.program, 1, self.batched)
        self.program.record("MAX_FEATURES", made, self, first=self.features)
        return made

    def pick(self, index: Value, size: int | None = None) -> Value:
        """Select the feature with number ``index``.

        :param size: select one in each block of this many features; None: all are one block
        :raises ValueError: if the features cannot be divided into such blocks
        """
        size = self.features if size is None else size
        made = Value(self.program, self.blocks_of(size), self.batched)

        def back(g: Value) -> Value:
            put = Value(self.program, self.features, self.batched)
            self.program.record("PUT", put, g, index, first=size)
            return put

        made.parents = ((self, back),)
        self.program.record("PICK", made, self, index, first=size)
        return made

    def sum(self) -> Value:
        """Sum over the batch, for each feature."""
        made = Value(self.program, self.features, False)

        def back(g: Value) -> Value:
            filled = Value(self.program, self.features, True)
            self.program.record("FILL", filled, g)
            return filled

        made.parents = ((self, back),)
        self.program.record("SUM_BATCH", made, self, tiled=False)
        return made

    def mean(self) -> Value:
        """Average over batch and features."""
        total = self.sum()
        if self.features > 1:
            total = total.sum_features()
        return total * (self.program.scalar("1 / batch") * (1.0 / self.features))
