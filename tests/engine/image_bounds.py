"""Calls the kernels of images on buffers of exactly the size they need; a program of test_native.

Without torch, as ``bounds.py``. Each map has a place of its own, in an order that is drawn.
"""

from __future__ import annotations

import ctypes
import sys

import numpy as np
from bounds import address, buffer, loaded, structure

LANES = 16
"""Images to a tile."""
SAME = [(3, 3), (1, 1), (1, 1)]
"""Kernel, stride and padding of a convolution that keeps the size."""


class Chain:
    """A chain on images.

    :param shape: channels, height and width of the images
    """

    def __init__(self, random, shape: tuple[int, int, int]) -> None:
        self.random = random
        self.shapes = [shape]
        self.steps: list[dict] = []
        self.ring = self.grad_ring = self.now = 0

    def add(
        self, kind: int, window: list, copies: bool = False, outputs: int = 0, **maps: int
    ) -> None:
        """Append a convolution (0) or pooling (1) of the map that was written last.

        :param copies: whether to write the positive part of the result too
        :param outputs: channels of a convolution's result; 0: any
        """
        maps = {"input": self.now, "add": -1, "gate": -1, "copy": -1, **maps}
        channels, *size = self.shapes[self.now]
        rows = channels if kind else outputs or int(self.random.integers(1, 5))
        rows = self.shapes[maps["add"]][0] if maps["add"] >= 0 else rows
        places = list(zip(size, *window, strict=True))
        result = [(n + 2 * p - k) // s + 1 for n, k, s, p in places]
        if not kind:
            for (n, k, s, p), m in zip(places, result, strict=True):
                self.ring = max(self.ring, p)
                self.grad_ring = max(self.grad_ring, (k - 1) // s, (n - 1 + p) // s - (m - 1))
        matrix = rows, channels * window[0][0] * window[0][1]
        step = {**maps, "source": self.now, "output": len(self.shapes), "kind": kind}
        self.now = len(self.shapes)
        self.shapes.append((rows, *result))
        if copies:
            step["copy"] = len(self.shapes)
            self.shapes.append((rows, *result))
        self.steps.append({**step, "window": window, "matrix": matrix})

    def run(self, lib, batch: int, threads: int, how: str, broken: bool) -> None:
        """One pass: ``forward``, ``one_by_one``, or ``backward`` behind a forward one.

        :param broken: whether the memory of the result is too short
        """
        keeps = how == "backward"
        at, size = self.placed(self.ring)
        grad_at, grad_size = self.placed(self.grad_ring)
        maps = [
            [*shape, keeps, *place] for shape, *place in zip(self.shapes, at, grad_at, strict=True)
        ]
        held: list = []
        begun: set[int] = set()
        for step in reversed(self.steps):
            begun.add(step["add"])
            step["adds"] = step["source"] in begun
            begun.add(step["source"])
        steps = []
        for step in self.steps:
            steps.append(self.packed(step, size, batch, held))
            if step["kind"]:
                size += -(-int(np.prod(self.shapes[step["output"]])) * LANES // 4)
        shapes = self.shapes[0], self.shapes[self.now]
        (x, y), (dx, dy) = ([buffer(batch, *shape) for shape in shapes] for _ in range(2))
        y = buffer(y.size - 1) if broken else y
        kept = buffer(-(-batch // LANES), size) if keeps else None
        for name in ("forward", "backward") if keeps else (how,):
            scratch = grad_size if name == "backward" else 0 if keeps else size
            sizes = [self.ring, self.grad_ring, size if keeps else 0, scratch]
            images = [
                len(steps),
                len(maps),
                batch,
                threads,
                *sizes,
                *map(address, (kept, x, y, dy, dx)),
            ]
            packed = (array_of([images]), array_of(maps), array_of(steps))
            assert getattr(lib, f"sb3_sparse_images_{name}")(*packed) == 0

    def placed(self, ring: int) -> tuple[list[int], int]:
        """A place for each map, and the size of the memory."""
        sizes = [c * (h + 2 * ring) * (w + 2 * ring) * LANES for c, h, w in self.shapes]
        places, size = [0] * len(sizes), 0
        for number in self.random.permutation(len(sizes)):
            places[number] = size
            size += sizes[number]
        return places, size

    def packed(self, step: dict, taken: int, batch: int, held: list) -> list[int]:
        """Fields of ``image_step_t``; the arrays stay in ``held``."""
        arrays: list = [
            None
        ] * 10  # connections, value and bias, and what is left of a backward pass
        if not step["kind"]:
            rows, taps = step["matrix"]
            found = structure(self.random, rows, taps, self.random.choice([0.0, 0.3, 1.0]), False)
            value, bias = (
                [buffer(len(found[1])), buffer(rows)],
                [buffer(len(found[1])), buffer(rows)],
            )
            arrays = [*found, *value, *bias, buffer(batch, *self.shapes[step["output"]])]
        held.append(arrays)
        plain = step["kind"] or step["add"] >= 0 or self.random.random() < 0.3
        activation = 0 if plain else int(self.random.choice([1, 2, 4, 12]))
        names = ("kind", "input", "source", "output", "add", "copy", "gate", "adds")
        numbers = [int(step[name]) for name in names]
        window = [number for pair in step["window"] for number in pair]
        return [*numbers, activation > 0, *window, taken, activation, 0, 0, *map(address, arrays)]


def drawn(random, padded: bool) -> Chain:
    """A chain of random windows.

    :param padded: whether there is padding; blocks have it
    """
    height, width = random.integers(1, (9, random.choice([9, 40])))
    chain = Chain(random, (int(random.integers(1, 4)), int(height), int(width)))
    for _ in range(int(random.integers(2, 5))):
        kind, block = int(random.integers(2)), padded and random.random() < 0.5
        size, kernel = chain.shapes[chain.now][1:], random.integers(1, 4, 2)
        most = kernel // 2 if kind else np.array([2, 2])
        padding = random.integers(0, most + 1) if padded else np.array([0, 0])
        kernel = np.minimum(kernel, size + 2 * padding)
        if kind:
            padding = np.minimum(padding, kernel // 2)
        window = [tuple(map(int, pair)) for pair in (kernel, random.integers(1, 4, 2), padding)]
        chain.add(kind, window, copies=block)
        if block:  # x + convolution(convolution(relu(x)))
            x, copy = chain.now, chain.now + 1
            chain.add(0, SAME, input=copy, gate=copy)
            chain.add(0, SAME, add=x)
    return chain


def pools(random) -> Chain:
    """Poolings of more channels than there are connections before them."""
    chain = Chain(random, (1, 8, 8))
    chain.add(0, [(1, 1), (1, 1), (0, 0)], outputs=40)
    for _ in range(2):
        chain.add(1, [(2, 2), (2, 2), (0, 0)])
    chain.add(0, [(1, 1), (1, 1), (0, 0)], outputs=1)
    return chain


def array_of(rows: list[list[int]]) -> ctypes.Array:
    numbers = [int(number) for row in rows for number in row]
    return (ctypes.c_int64 * len(numbers))(*numbers)


def main() -> None:
    path, instructions, *broken = sys.argv[1:]
    lib = loaded(path, instructions)
    random = np.random.default_rng(0)
    count = 0
    for batch in (1, 2, 15, 16, 17, 33):
        for how in ("forward", "one_by_one", "backward"):
            for threads in (1, 2):
                for padded in (False, True) * 3:
                    drawn(random, padded).run(lib, batch, threads, how, bool(broken))
                    count += 1
                pools(random).run(lib, batch, threads, how, bool(broken))
                count += 1
    print(count, "passes")


if __name__ == "__main__":
    main()
