"""Modules on images, drawn at random by Hypothesis."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from hypothesis import strategies as st
from torch import nn

from sb3_sparse.engine.residual import Residual

Activation = Callable[[], nn.Module]
EXACT: list[Activation] = [
    nn.Identity,
    nn.ReLU,
    nn.ReLU6,
    partial(nn.LeakyReLU, 0.25),
    partial(nn.LeakyReLU, -0.5),
    partial(nn.Hardtanh, -2.0, 3.0),
]
"""Of whole numbers they make numbers that float32 can hold."""
SMOOTH: list[Activation] = [
    nn.Identity,
    nn.ReLU,
    nn.Tanh,
    nn.Sigmoid,
    nn.ELU,
    partial(nn.ELU, 0.3),
    partial(nn.CELU, 1.4),
    nn.SELU,
    partial(nn.LeakyReLU, 0.2),
    partial(nn.Hardtanh, -0.5, 0.75),
    nn.GELU,
    nn.SiLU,
]


class Drawn:
    """Modules on images, drawn one after the other so that sizes fit.

    :param draw: of Hypothesis
    :param activations: to draw from
    :param pools: how many poolings there may be
    """

    def __init__(self, draw, activations: list[Activation], pools: int) -> None:
        self.draw, self.activations, self.pools = draw, activations, pools
        self.channels = draw(st.integers(1, 4))
        # Wider than the places that the kernels take at once, too.
        self.size = [draw(st.integers(1, 9)), draw(st.integers(1, 9) | st.integers(10, 36))]
        self.shape = (self.channels, *self.size)
        self.modules: list[nn.Module] = []
        for _ in range(draw(st.integers(1, 4))):
            self.modules += self.some(depth=2)

    def __repr__(self) -> str:
        return f"{self.shape} -> {self.modules}"

    def some(self, depth: int) -> list[nn.Module]:
        kind = self.draw(st.sampled_from(["convolution"] * 3 + ["pool", "block", "other", "inner"]))
        if kind == "pool" and self.pools:
            self.pools -= 1
            return [self.pool(), *self.draw(st.sampled_from([[], [nn.ReLU()]]))]
        if kind == "block" and depth:
            return [self.block(depth)]
        if kind == "inner" and depth:
            return [nn.Sequential(*self.some(depth - 1), *self.some(depth - 1))]
        if kind == "other":
            return [self.activation()]
        in_place = self.draw(st.booleans())
        return [self.convolution(), nn.ReLU(inplace=True) if in_place else self.activation()]

    def activation(self) -> nn.Module:
        return self.draw(st.sampled_from(self.activations))()

    def convolution(self) -> nn.Conv2d:
        pairs = st.tuples(st.integers(1, 4), st.integers(1, 4))
        kernel, stride = self.draw(pairs), self.draw(st.sampled_from([(1, 1), (2, 1), (2, 3)]))
        padding = self.draw(st.tuples(st.integers(0, 2), st.integers(0, 2)))
        padding = tuple(
            max(p, (k - size + 1) // 2)
            for p, k, size in zip(padding, kernel, self.size, strict=True)
        )
        outputs, bias = self.draw(st.integers(1, 4)), self.draw(st.booleans())
        layer = nn.Conv2d(self.channels, outputs, kernel, stride, padding, bias=bias)
        self.channels = outputs
        self._measure(kernel, stride, padding)
        return layer

    def pool(self) -> nn.MaxPool2d:
        kernel = tuple(min(self.draw(st.integers(1, 3)), size) for size in self.size)
        stride = self.draw(st.tuples(st.integers(1, 3), st.integers(1, 3)))
        padding = tuple(self.draw(st.integers(0, k // 2)) for k in kernel)
        self._measure(kernel, stride, padding)
        return nn.MaxPool2d(kernel, stride, padding)

    def block(self, depth: int) -> Residual:
        """A block whose convolutions keep the size; those within may change the channels."""
        before, inner = self.channels, list[nn.Module]()
        for _ in range(self.draw(st.integers(0, 2))):
            nested = depth > 1 and self.draw(st.integers(0, 3)) == 0
            inner += [self.block(depth - 1)] if nested else self._same(self.draw(st.integers(1, 3)))
        inner += self._same(before)
        return Residual(*inner)

    def _same(self, outputs: int) -> list[nn.Module]:
        kernel = self.draw(st.sampled_from([(1, 1), (3, 3), (1, 3), (5, 1)]))
        layer = nn.Conv2d(self.channels, outputs, kernel, padding=tuple(k // 2 for k in kernel))
        self.channels = outputs
        return [*self.draw(st.sampled_from([[], [self.activation()], [nn.ReLU()]])), layer]

    def _measure(self, *window: tuple[int, ...]) -> None:
        self.size = [
            (size + 2 * p - k) // s + 1 for size, k, s, p in zip(self.size, *window, strict=True)
        ]


def drawn(activations: list[Activation], pools: int) -> st.SearchStrategy[Drawn]:
    return st.composite(lambda draw: Drawn(draw, activations, pools))()
