"""Calls the kernels on buffers of exactly the size they need; a program of test_native.

Without torch, so that every buffer is NumPy's own and the address sanitizer watches its ends.
"""

from __future__ import annotations

import ctypes
import struct
import sys

import numpy as np

TILE = 64


def address(array: np.ndarray | None) -> int:
    return 0 if array is None else array.ctypes.data


def buffer(*shape: int) -> np.ndarray:
    return np.zeros(shape, dtype=np.float32)


def structure(random, rows: int, columns: int, density: float, broken: bool) -> list[np.ndarray]:
    row, column = np.nonzero(random.random((rows, columns)) < density)
    order = np.argsort(column, kind="stable")
    starts = [
        np.concatenate([[0], np.cumsum(np.bincount(index, minlength=count))])
        for index, count in ((row, rows), (column, columns))
    ]
    if broken:
        column = np.where(column == columns - 1, columns + 5, column)
    parts = [starts[0], column, starts[1], row[order], order]
    return [np.ascontiguousarray(part, dtype=np.int32) for part in parts]


def one_pass(lib, random, widths: list[int], batch: int, tiled: bool, threads: int, broken: bool):
    tiles = -(-batch // TILE)
    layers, kept = [], []
    for columns, rows in zip(widths, widths[1:], strict=False):
        arrays = structure(random, rows, columns, random.choice([0.0, 0.3, 1.0]), broken)
        nnz = len(arrays[1])
        values, bias = buffer(nnz), buffer(rows) if random.random() < 0.5 else None
        grads = buffer(nnz), None if bias is None else buffer(rows)
        output, left = buffer(tiles, rows, TILE), buffer(tiles, rows, TILE)
        kept += [arrays, values, bias, grads, output, left]
        activation = int(random.choice([0, 1, 2, 3, 4, 6, 12, 13]))
        layers += [rows, columns, activation, 0, 0, *map(address, arrays)]
        layers += map(address, (values, bias, output, *grads, left))
    packed = (ctypes.c_int64 * len(layers))(*layers)
    into, out = widths[0], widths[-1]
    shape_in = (tiles, into, TILE) if tiled else (batch, into)
    shape_out = (tiles, out, TILE) if tiled else (batch, out)
    x, dx, y, dy = buffer(*shape_in), buffer(*shape_in), buffer(*shape_out), buffer(*shape_out)
    work = x if tiled else buffer(tiles, into, TILE)
    where = (0, address(dy), 0, address(dx)) if tiled else (address(dy), 0, address(dx), 0)
    rows_in, rows_out = (0, 0) if tiled else (address(x), address(y))
    argument = (ctypes.c_int64 * 10)(
        len(widths) - 1, batch, threads, address(work), rows_in, rows_out, *where
    )
    lib.sb3_sparse_forward(packed, argument)
    assert lib.sb3_sparse_backward(packed, argument) == 0


def one_act(lib, random, widths: list[int], batch: int, broken: bool):
    """A trunk with two heads, of layers of every storage."""
    steps, kept, total = [], [], 0
    for number, (columns, rows) in enumerate([*zip(widths, widths[1:], strict=False), widths[-2:]]):
        storage = random.choice(["sparse", "masked", "dense"])
        arrays = structure(random, rows, columns, random.choice([0.0, 0.3, 1.0]), broken)
        sparse = storage == "sparse"
        values = buffer(len(arrays[1])) if sparse else buffer(rows, columns)
        mask = buffer(rows, columns) if storage == "masked" else None
        bias = buffer(rows) if random.random() < 0.5 else None
        kept += [arrays, values, mask, bias]
        head = number >= len(widths) - 2
        places = map(address, arrays[:2]) if sparse else (0, 0)
        steps += [rows, columns, *places, address(values), address(mask), address(bias)]
        source = number - 1 - (number == len(widths) - 1)
        steps += [int(random.integers(15)), 0, 0, source, total if head else -1]
        norm = random.random() < 0.5
        own = norm and random.random() < 0.5
        some = [own or (norm and random.random() < 0.5) for _ in range(2)]
        affine = [buffer(columns) if there else None for there in some]
        statistics = [buffer(columns) if own else None for _ in range(2)]
        kept += [affine, statistics]
        epsilon = struct.unpack("q", struct.pack("d", 1e-6 if norm else -1.0))[0]
        alike = [n for n, w in enumerate(widths[: number + 1], -1) if w == rows] if not head else []
        added = int(random.choice(alike)) if alike and random.random() < 0.7 else -2
        steps += [epsilon, *map(address, affine + statistics), added]
        total += rows if head else 0
    packed = (ctypes.c_int64 * len(steps))(*steps)
    doubles = int(random.integers(2))
    x, y = buffer(batch, widths[0] * (1 + doubles)), buffer(batch, total)
    pointers = [ctypes.c_void_p(address(array)) for array in (x, y)]
    count = ctypes.c_int64(len(widths))
    sizes = count, ctypes.c_int64(batch), doubles
    assert lib.sb3_sparse_act(packed, *sizes, *pointers) in (0, 1)


def loaded(path: str, instructions: str) -> ctypes.CDLL:
    """The library, with an instruction set and threads to share."""
    lib = ctypes.CDLL(path)
    assert lib.sb3_sparse_use(instructions.encode()) == 0
    openmp = ctypes.CDLL("libgomp.so.1")
    names = ("GOMP_parallel", "omp_get_thread_num", "omp_get_num_threads")
    functions = [ctypes.cast(getattr(openmp, name), ctypes.c_void_p) for name in names]
    lib.sb3_sparse_share_threads(*functions)
    return lib


def main() -> None:
    path, instructions, *broken = sys.argv[1:]
    lib = loaded(path, instructions)
    random = np.random.default_rng(0)
    count = 0
    for batch in (1, 3, 16, 17, 63, 64, 65, 130):
        for tiled in (False, True):
            for threads in (1, 2):
                widths = random.integers(1, 40, size=random.integers(2, 5)).tolist()
                one_pass(lib, random, widths, batch, tiled, threads, bool(broken))
                count += 1
    for batch in (1, 2, 4, 5, 8, 9, 12, 13, 16):
        for _ in range(8):
            widths = random.integers(1, 40, size=random.integers(3, 6)).tolist()
            one_act(lib, random, widths, batch, bool(broken))
            count += 1
    print(count, "passes")


if __name__ == "__main__":
    main()
