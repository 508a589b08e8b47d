"""The memory of passes of images: what is read at the same time lies apart."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import combinations

import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from image_modules import EXACT, Drawn, drawn
from image_support import twins
from torch import nn

from sb3_sparse.engine.image_layout import LANES, Layout, lay_out
from sb3_sparse.engine.image_modules import steps_of
from sb3_sparse.engine.image_step import ImageStep, Window

ONE = Window((1, 1), (1, 1), (0, 0))
SAME = Window((3, 3), (1, 1), (1, 1))


def convolution(outputs: int, inputs: int, window: Window, *maps: int, **rest) -> ImageStep:
    return ImageStep(window, (outputs, inputs, *window.kernel), None, *maps, **rest)


def planned(network: Drawn) -> Iterator[tuple[list[ImageStep], tuple[int, int, int]]]:
    """The steps of each chain of a network, and the shape of its images."""
    _, sparse = twins(*network.modules)
    modules, x = list(sparse), th.zeros(1, *network.shape)
    while modules:
        steps, _, count = steps_of(modules)
        if steps:
            yield steps, tuple(x.shape[1:])
        for module in modules[: max(count, 1)]:
            x = module(x)
        del modules[: max(count, 1)]


def size_of(shape: tuple[int, int, int], ring: int) -> int:
    channels, height, width = shape
    return channels * (height + 2 * ring) * (width + 2 * ring) * LANES


def apart(*places: tuple[int, int]) -> bool:
    """Whether ranges ``(begin, size)`` do not overlap."""
    return all(a + n <= b or b + m <= a for (a, n), (b, m) in combinations(places, 2))


def times_of_maps(steps: list[ImageStep]) -> dict[int, set[int]]:
    """During which steps a map must hold its content: from its writer to its last reader."""
    touched = defaultdict(list, {0: [-1]})
    for i, step in enumerate(steps):
        for number in (step.input, step.add, step.output, step.copy):
            if number is not None:
                touched[number].append(i)
    touched[steps[-1].output].append(len(steps))
    return {number: set(range(min(t), max(t) + 1)) for number, t in touched.items()}


def places(layout: Layout, numbers, ring: int) -> list[tuple[int, int]]:
    return [(layout.maps[n].at, size_of(layout.maps[n].shape, ring)) for n in numbers]


@settings(max_examples=100, deadline=None)
@given(network=drawn(EXACT, pools=3), keep=st.booleans())
def test_maps_of_the_forward_pass_lie_apart(network, keep):
    for steps, shape in planned(network):
        layout = lay_out(steps, shape, keep)
        loose = [number for number, m in enumerate(layout.maps) if not m.kept]
        kept = [number for number, m in enumerate(layout.maps) if m.kept]
        times = times_of_maps(steps)
        for i in range(-1, len(steps) + 1):
            alive = [number for number in loose if i in times[number]]
            assert apart(*places(layout, alive, layout.ring))
        for at, size in places(layout, loose, layout.ring):
            assert 0 <= at <= layout.forward_size - size
            assert at % LANES == 0
        taken = [
            (place, -(-size_of(layout.maps[step.output].shape, 0) // 4))
            for step, place in zip(steps, layout.taken, strict=True)
            if keep and step.weight is None
        ]
        stays = [*places(layout, kept, layout.ring), *taken]
        assert apart(*stays)
        assert all(0 <= at <= layout.kept_size - size for at, size in stays)
        if not keep:
            assert not kept
            assert layout.kept_size == 0


@settings(max_examples=100, deadline=None)
@given(network=drawn(EXACT, pools=3))
def test_the_backward_pass_keeps_what_it_reads(network):
    for steps, shape in planned(network):
        layout = lay_out(steps, shape, True)
        for step, back in zip(steps, layout.backward, strict=True):
            if step.weight is not None:
                assert layout.maps[step.input].kept  # for the gradient of the values
            if back.slope:
                assert layout.maps[step.output].kept
            if back.gate is not None:
                assert layout.maps[back.gate].kept
            # The slope of an activation counts once: here, or by the next step's gate.
            gates = [b.gate for b in layout.backward if b.gate == step.output]
            assert back.slope + len(gates) == (step.activation is not None)


class Memory:
    """What has been added up in the gradient of each map, in the places of a layout."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.held: dict[int, tuple[int, frozenset[str]]] = {}  # by place: size, and what it holds

    def range(self, number: int) -> tuple[int, int]:
        at, shape = self.layout.maps[number].grad_at, self.layout.maps[number].shape
        size = size_of(shape, self.layout.grad_ring)
        assert 0 <= at <= self.layout.backward_size - size
        return at, size

    def write(self, number: int, terms: frozenset[str]) -> None:
        at, size = self.range(number)
        for other, (length, _) in list(self.held.items()):
            if not apart((at, size), (other, length)):
                del self.held[other]
        self.held[at] = size, terms

    def read(self, number: int) -> frozenset[str]:
        return self.held[self.range(number)[0]][1]


@settings(max_examples=100, deadline=None)
@given(network=drawn(EXACT, pools=3))
def test_gradients_add_up_and_lie_apart_until_they_are_read(network):
    for steps, shape in planned(network):
        layout = lay_out(steps, shape, True)
        memory, last = Memory(layout), steps[-1].output
        memory.write(last, frozenset({"result"}))
        due: dict[int, set[str]] = defaultdict(set, {last: {"result"}})
        for i in reversed(range(len(steps))):  # as the kernels go back
            step, back = steps[i], layout.backward[i]
            assert memory.read(step.output) == due[step.output]
            if step.add is not None:
                due[step.add] |= due[step.output]
                if memory.range(step.add) != memory.range(step.output):
                    memory.write(step.add, memory.read(step.output))
            due[step.source].add(f"step {i}")
            before = memory.read(step.source) if back.adds else frozenset()
            assert apart(memory.range(step.source), memory.range(step.output))
            memory.write(step.source, before | {f"step {i}"})
        assert memory.read(0) == due[0]


def test_rings_are_as_wide_as_taps_reach():
    # 5 wide, kernel 3, stride 2, padding 1: 3 results; the first and the last tap reach one
    # place beyond the image. Places of the image meet results 0..2, and -1 by the third tap.
    step = convolution(1, 1, Window((3, 3), (2, 2), (1, 1)), 0, 0, 1)
    layout = lay_out([step], (1, 5, 5), True)
    assert (layout.ring, layout.grad_ring) == (1, 1)
    # 6 wide, kernel 1, stride 1: nothing reaches beyond.
    layout = lay_out([convolution(1, 1, ONE, 0, 0, 1)], (1, 6, 6), True)
    assert (layout.ring, layout.grad_ring) == (0, 0)
    # 5 wide, kernel 4, stride 1, no padding: 2 results; the last place meets results 1..4.
    layout = lay_out([convolution(1, 1, Window((4, 1), (1, 1), (0, 0)), 0, 0, 1)], (1, 5, 1), True)
    assert (layout.ring, layout.grad_ring) == (0, 3)


def test_shapes_that_do_not_fit_have_no_layout():
    steps = [convolution(2, 3, SAME, 0, 0, 1), convolution(3, 2, SAME, 1, 1, 2, add=0)]
    assert lay_out(steps, (3, 4, 5), True) is not None
    assert lay_out(steps, (2, 4, 5), True) is None  # channels
    narrow = convolution(3, 2, Window((3, 3), (1, 1), (0, 0)), 1, 1, 2, add=0)
    assert lay_out([steps[0], narrow], (3, 4, 5), True) is None  # another size than what is added
    assert lay_out([narrow._replace(input=0, source=0, add=None)], (2, 2, 9), True) is None
    assert lay_out(steps, (3, 0, 5), True) is None  # though a padding makes places of it
    assert lay_out(steps, (3, 4, 0), True) is None
    assert lay_out(steps, (3, 60000, 60000), True) is None  # beyond 32 bits
    # Dealt out by such a stride, 9 x 9 numbers take 60000 x 60000 places.
    far = Window((3, 3), (60000, 60000), (0, 0))
    assert lay_out([convolution(2, 3, far, 0, 0, 1)], (3, 9, 9), True) is None


@pytest.mark.parametrize(
    "window", [((0, 3), (1, 1), (1, 1)), ((3, 3), (1, 0), (1, 1)), ((3, 3), (1, 1), (-1, 1))]
)
def test_windows_that_torch_rejects_have_no_layout(window):
    assert lay_out([convolution(2, 3, Window(*window), 0, 0, 1)], (3, 9, 9), True) is None


def test_windows_are_read_from_modules():
    pool = nn.MaxPool2d([3, 2], padding=(1, 0))
    assert Window.of(pool) == ((3, 2), (3, 2), (1, 0))
    assert Window.of(nn.Conv2d(1, 1, 3, stride=(2, 1))) == ((3, 3), (2, 1), (0, 0))
    # By torch's formula, floor((size + 2 padding - kernel) / stride) + 1.
    assert Window((3, 2), (2, 3), (1, 0)).result(5, 7) == (3, 2)
