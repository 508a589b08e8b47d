"""Modules that the kernels compute on images, as steps of a chain."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from math import prod
from operator import attrgetter
from typing import Any, NamedTuple

from torch import nn

from sb3_sparse.engine.activations import tells_its_slope
from sb3_sparse.engine.convolution import SparseConv2d, convolution_attributes
from sb3_sparse.engine.image_step import ImageStep, Window
from sb3_sparse.engine.paths import called_by, is_residual, is_sequence


class _Enter(NamedTuple):
    """Marks where a residual block begins."""


class _Leave(NamedTuple):
    """Marks where a residual block ends."""


_ATTRIBUTES: dict[type[nn.Module], Callable[[Any], Any]] = {
    SparseConv2d: convolution_attributes,
    nn.MaxPool2d: attrgetter(
        "kernel_size", "stride", "padding", "dilation", "ceil_mode", "return_indices"
    ),
    nn.ReLU: attrgetter("inplace"),
}
"""Attributes that the steps depend on."""


class ImageAttributes:
    """Attributes of modules on images as they are now.

    :param modules: the modules, also such that have none
    """

    def __init__(self, modules: Iterable[nn.Module]) -> None:
        self._read = [(_ATTRIBUTES[type(m)], m) for m in modules if type(m) in _ATTRIBUTES]
        self._found = deepcopy(self._now())

    def unchanged(self) -> bool:
        """Whether nothing has changed since creation."""
        return self._now() == self._found

    def _now(self) -> list[Any]:
        return [read(module) for read, module in self._read]


Token = nn.Module | _Enter | _Leave


def has_convolution(module: nn.Module) -> bool:
    """Whether a module is a sparse convolution, or a residual block or ``Sequential`` with one."""
    if is_residual(module) or is_sequence(module):
        return any(map(has_convolution, called_by(module)))
    return type(module) is SparseConv2d


def steps_of(modules: Sequence[nn.Module]) -> tuple[list[ImageStep], list[SparseConv2d], int]:
    """Turn as many modules as possible into steps, from the first one on.

    :param modules: modules in the order in which they are called
    :return: the steps, their convolutions, and the number of modules that they stand for; none if
        there is no convolution in sparse storage among them
    """
    for count in range(len(modules), 0, -1):
        tokens = _tokens(modules[:count])
        steps = None if tokens is None else _steps(tokens)
        if tokens and steps:
            layers = [token for token in tokens if isinstance(token, SparseConv2d)]
            if layers:
                return steps, layers, count
    return [], [], 0


def _is_pool(module: nn.Module) -> bool:
    if type(module) is not nn.MaxPool2d:
        return False
    window = Window.of(module)
    return (
        module.dilation in (1, (1, 1))
        and not module.ceil_mode
        and not module.return_indices
        and prod(window.kernel) <= 128  # the kernels number them by bytes
        and all(2 * p <= k for k, _, p in zip(*window, strict=True))  # torch objects to more
    )


def is_between(module: nn.Module) -> bool:
    """Whether the kernels compute a module between two convolutions."""
    return _is_pool(module) or tells_its_slope(module) or type(module) is nn.Identity


def in_order(module: nn.Module) -> Iterator[nn.Module]:
    """Go through what a ``Sequential`` or a residual block calls, in that order."""
    for child in called_by(module):
        if is_sequence(child) or is_residual(child):
            yield from in_order(child)
        else:
            yield child


def _tokens(modules: Iterable[nn.Module]) -> list[Token] | None:
    """Flatten modules; None if one is not computed by the kernels."""
    found: list[Token] = []
    for module in modules:
        if is_sequence(module) or is_residual(module):
            inner = _tokens(called_by(module))
            if inner is None:
                return None
            found += [_Enter(), *inner, _Leave()] if is_residual(module) else inner
        elif type(module) is SparseConv2d:
            if not module.is_computed:
                return None
            found.append(module)
        elif _is_pool(module) or tells_its_slope(module):
            found.append(module)
        elif type(module) is not nn.Identity:
            return None
    return found


def _steps(tokens: Sequence[Token]) -> list[ImageStep] | None:
    """Turn modules into steps; None where they do not fit together in a way that is computed."""
    steps: list[ImageStep] = []
    now = source = maps = 0
    held: list[int] = []  # inputs of the blocks that are open
    for token in tokens:
        last = steps[-1] if steps else None
        if isinstance(token, _Enter):
            if now != source or now in held:  # the kernels add one gradient to a block's input
                return None
            held.append(now)
        elif isinstance(token, _Leave):
            add = held.pop()
            if (
                last is None
                or now == add
                or now != source
                or last.activation
                or last.add is not None
                or last.weight is None
            ):
                return None  # the kernels add to what a convolution has just made
            steps[-1] = last._replace(add=add)
        elif isinstance(token, SparseConv2d | nn.MaxPool2d):
            if now != source and not isinstance(token, SparseConv2d):
                return None
            maps += 1
            weight = token.dense_shape if isinstance(token, SparseConv2d) else None
            steps.append(ImageStep(Window.of(token), weight, None, now, source, maps))
            now = source = maps
        elif last is None or now != source or last.output != now:
            return None  # an activation needs a step whose result it takes
        elif (
            last.weight is not None
            and last.activation is None
            and last.add is None
            and now not in held
        ):
            steps[-1] = last._replace(activation=token)
        elif type(token) is nn.ReLU and last.copy is None and not (token.inplace and now in held):
            maps += 1
            steps[-1] = last._replace(copy=maps)
            now = maps
        else:
            return None
    return steps if now == source and not held else None
