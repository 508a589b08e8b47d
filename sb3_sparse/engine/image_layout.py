"""The memory of passes of images through convolutions and poolings.

A chain is a list of steps between numbered maps: map 0 is the input, and each step writes the next
maps. A layout gives every map, and its gradient, a place in memory for images of one size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import prod
from typing import Any, NamedTuple

from torch import nn

LANES = 16
"""Images to a tile; ``kernels.h`` has the same number."""
LIMIT = 2**31 - 1
"""The kernels find numbers within a map by 32-bit offsets."""
Shape = tuple[int, int, int]
"""Channels, height and width."""


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


class Map(NamedTuple):
    """A map's shape and places in memory, in numbers of a tile.

    :param kept: whether the backward pass reads it
    :param at: place among the kept maps, or in the scratch memory of a thread
    :param grad_at: place of its gradient in the scratch memory of the backward pass; None: it has
        none
    """

    shape: Shape
    kept: bool
    at: int
    grad_at: int | None


class Backward(NamedTuple):
    """What the backward pass of a step does besides its products.

    :param gate: number of the map where the gradient of the source counts: where it is positive
    :param adds: whether the gradient of the source has begun
    :param slope: whether it begins with the slope of the step's activation
    """

    gate: int | None
    adds: bool
    slope: bool


class Layout(NamedTuple):
    """The memory of passes of images of one size.

    :param maps: the maps by number
    :param backward: of each step
    :param taken: of each pooling, the place of the taps that it took, among the kept maps
    :param ring: zeros around each channel of a map
    :param grad_ring: zeros around each channel of a gradient
    :param kept_size: numbers of all kept maps of a tile
    :param forward_size: scratch numbers of a thread in the forward pass
    :param backward_size: scratch numbers of a thread in the backward pass
    """

    maps: list[Map]
    backward: list[Backward]
    taken: list[int]
    ring: int
    grad_ring: int
    kept_size: int
    forward_size: int
    backward_size: int


def lay_out(steps: Sequence[ImageStep], shape: Shape, keep: bool) -> Layout | None:
    """Lay out the memory for images of a shape; None if the shape does not fit the steps.

    :param keep: whether a backward pass may follow
    """
    assert all(step.activation is None or step.add is None for step in steps)
    shapes = _shapes(steps, shape)
    if shapes is None:
        return None
    backward, kept, origin = _gradients(steps, len(shapes))
    ring, grad_ring = _rings(steps, shapes)
    sizes = [_size(shape, ring) for shape in shapes]
    grad_sizes = [_size(shape, grad_ring) for shape in shapes]
    if max(*sizes, *grad_sizes, *_dealt_sizes(steps, shapes)) > LIMIT:
        return None
    at, kept_size = [0] * len(shapes), 0
    for number in sorted(kept) if keep else ():
        at[number] = kept_size
        kept_size += sizes[number]
    taken = []
    for step in steps:
        taken.append(kept_size)
        if keep and step.weight is None:
            kept_size += -(-_size(shapes[step.output], 0) // 4 // LANES) * LANES
    lives = _lives(steps, len(shapes))
    loose = [number for number in range(len(shapes)) if not (keep and number in kept)]
    places, forward_size = _fit([(*lives[number], sizes[number]) for number in loose])
    for number, place in zip(loose, places, strict=True):
        at[number] = place
    grad_at, backward_size = _gradient_places(steps, grad_sizes, origin)
    maps = [
        Map(shapes[number], keep and number in kept, at[number], grad_at.get(number))
        for number in range(len(shapes))
    ]
    return Layout(maps, backward, taken, ring, grad_ring, kept_size, forward_size, backward_size)


def _size(shape: Shape, ring: int) -> int:
    return shape[0] * (shape[1] + 2 * ring) * (shape[2] + 2 * ring) * LANES


def _dealt_sizes(steps: Sequence[ImageStep], shapes: Sequence[Shape]) -> Iterator[int]:
    """Bound the numbers of an image that ``one_image.c`` deals out by the strides of each step."""
    for step in steps:
        channels, *sizes = shapes[step.input]
        _, strides, paddings = step.window
        yield channels * prod(
            size + 2 * p + s for size, s, p in zip(sizes, strides, paddings, strict=True)
        )


def _shapes(steps: Sequence[ImageStep], shape: Shape) -> list[Shape] | None:
    """Compute the shape of every map; None where sizes, channels or windows do not fit."""
    if min(shape) < 1:
        return None
    count = 1 + max(number for step in steps for number in (step.output, step.copy or 0))
    shapes: list[Shape] = [shape] * count
    for step in steps:
        channels, height, width = shapes[step.input]
        if step.weight is not None:
            if channels != step.weight[1]:
                return None
            channels = step.weight[0]
        if min(*step.window.kernel, *step.window.stride) < 1 or min(step.window.padding) < 0:
            return None
        height, width = step.window.result(height, width)
        result = (channels, height, width)
        if min(result) < 1 or (step.add is not None and shapes[step.add] != result):
            return None
        shapes[step.output] = result
        if step.copy is not None:
            shapes[step.copy] = result
    return shapes


def _rings(steps: Sequence[ImageStep], shapes: Sequence[Shape]) -> tuple[int, int]:
    """Compute the zeros that convolutions read around a map, and around a gradient."""
    ring = grad_ring = 0
    for step in steps:
        if step.weight is None:
            continue
        sizes = zip(shapes[step.input][1:], shapes[step.output][1:], *step.window, strict=True)
        for size, result, kernel, stride, padding in sizes:
            ring = max(ring, padding)
            before = (kernel - 1) // stride
            behind = (size - 1 + padding) // stride - (result - 1)
            grad_ring = max(grad_ring, before, behind)
    return ring, grad_ring


def _gradients(
    steps: Sequence[ImageStep], count: int
) -> tuple[list[Backward], set[int], list[int]]:
    """Plan the backward pass.

    :param count: number of maps
    :return: what each step does, the maps that it reads, and for each map the one that it shares
        its gradient with, which may be itself
    """
    producer = {step.output: step for step in steps}
    begun: set[int] = set()
    gated: set[int] = set()
    kept: set[int] = set()
    origin = list(range(count))
    backward: list[Backward] = []
    for step in reversed(steps):
        slope = step.activation is not None and step.output not in gated
        if slope:
            kept.add(step.output)
        if step.add is not None:
            if step.source != step.add:  # else the kernels would read what they write
                origin[step.add] = origin[step.output]
            begun.add(step.add)
        adds, gate = step.source in begun, None
        if step.weight is not None:
            kept.add(step.input)
            before = producer.get(step.source)
            if step.input != step.source:
                gate = step.input
            elif not adds and before is not None and type(before.activation) is nn.ReLU:
                gate = step.input
                gated.add(step.source)
        begun.add(step.source)
        backward.append(Backward(gate, adds, slope))
    return backward[::-1], kept, origin


def _lives(steps: Sequence[ImageStep], count: int) -> list[tuple[int, int]]:
    """Find the step before which each map begins, and the last that reads it."""
    begins, ends = [-1] * count, [-1] * count
    for i, step in enumerate(steps):
        for number in (step.output, step.copy):
            if number is not None:
                begins[number] = ends[number] = i
        for number in (step.input, step.add):
            if number is not None:
                ends[number] = i
    ends[steps[-1].output] = len(steps)
    return list(zip(begins, ends, strict=True))


def _gradient_places(
    steps: Sequence[ImageStep], sizes: Sequence[int], origin: Sequence[int]
) -> tuple[dict[int, int], int]:
    """Place the gradients of all maps that have one; return the memory's size too."""
    lives: dict[int, list[int]] = {origin[steps[-1].output]: [-1, -1]}
    numbers = {number for step in steps for number in (step.output, step.source)}
    for i, step in enumerate(reversed(steps)):
        for number in (step.output, step.source, step.add):
            if number is None:
                continue
            lives.setdefault(origin[number], [i, i])[1] = i
    lives[origin[0]][1] = len(steps)  # it is handed over at the end
    owners = list(lives)
    places, size = _fit([(lives[owner][0], lives[owner][1], sizes[owner]) for owner in owners])
    by_owner = dict(zip(owners, places, strict=True))
    return {number: by_owner[origin[number]] for number in numbers}, size


def _fit(items: Sequence[tuple[int, int, int]]) -> tuple[list[int], int]:
    """Give each item ``(first, last, size)`` a place apart from all that live at the same time.

    :return: the places, and the size of the memory
    """
    places: list[int] = []
    for first, last, size in items:
        taken = [
            (place, place + other_size)
            for (begin, end, other_size), place in zip(items, places, strict=False)
            if begin <= last and first <= end
        ]
        at = 0
        for begin, end in sorted(taken):
            if at + size <= begin:
                break
            at = max(at, end)
        places.append(at)
    ends = [place + size for place, (*_, size) in zip(places, items, strict=True)]
    return places, max(ends, default=0)
