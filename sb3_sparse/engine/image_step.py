"""One step of a chain of convolutions and poolings.

A chain is a list of steps between numbered maps: map 0 is the input, and each step writes the next
maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import nn


def _pair(value: Any) -> tuple[int, int]:
    if isinstance(value, Sequence):
        return int(value[0]), int(value[-1])
    return int(value), int(value)


class Window(NamedTuple):
    """Kernel, stride and padding of a convolution or pooling, each by height and width."""

    kernel: tuple[int, int]
    stride: tuple[int, int]
    padding: tuple[int, int]

    @classmethod
    def of(cls, module: nn.Conv2d | nn.MaxPool2d) -> Window:
        """Read the window of a module."""
        return cls(_pair(module.kernel_size), _pair(module.stride), _pair(module.padding))

    def result(self, height: int, width: int) -> tuple[int, int]:
        """Compute the size of the result for an input of that size; below 1 there is none."""
        (ky, kx), (sy, sx), (py, px) = self
        return (height + 2 * py - ky) // sy + 1, (width + 2 * px - kx) // sx + 1


class ImageStep(NamedTuple):
    """One step: ``activation(convolution(input))``, ``convolution(input) + add`` or a pooling.

    A step that adds has no activation. It holds no layer, so that a graph may hold it.

    :param window: of the convolution or pooling
    :param weight: shape of the convolution's dense weight; None: it is a pooling
    :param activation: None: no activation
    :param input: number of the map that is read
    :param source: number of the map that the input is the positive part of, or the input itself
    :param output: number of the map that is written
    :param add: number of the map that is added; None: nothing is added
    :param copy: number of the map that gets the positive part of the output; None: nobody reads it
    """

    window: Window
    weight: tuple[int, ...] | None
    activation: nn.Module | None
    input: int
    source: int
    output: int
    add: int | None = None
    copy: int | None = None
