"""Where the maps of a chain, and their gradients, lie in memory, for images of one size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import prod
from typing import NamedTuple

from sb3_sparse.engine.image_backward import Backward, plan_backward
from sb3_sparse.engine.image_step import ImageStep

LANES = 16
"""Images to a tile; ``kernels.h`` has the same number."""
LIMIT = 2**31 - 1
"""The kernels find numbers within a map by 32-bit offsets."""
Shape = tuple[int, int, int]
"""Channels, height and width."""


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
    backward, kept, origin = plan_backward(steps, len(shapes))
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
