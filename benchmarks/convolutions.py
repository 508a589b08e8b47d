"""Single convolutions for sparse_compute.py: forward and backward, dense and sparse."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import Any, NamedTuple

import numpy as np
import torch as th
from compute_rows import rows_of
from rounds import interleaved

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.sequential import chain_up
from sb3_sparse.engine.structure import Structure

BATCH = 32
CHAIN = 5
"""Layers of the longer chain."""
WORK = 5e9
"""Arithmetic operations of the dense layer in one timing, at least."""


class Convolution(NamedTuple):
    """A convolution with ReLU on square images.

    :param kernel: height and width of the kernel
    :param inputs: channels of the input
    :param outputs: channels of the output
    :param width: height and width of the input
    """

    kernel: int
    stride: int
    padding: int
    inputs: int
    outputs: int
    width: int

    def __str__(self) -> str:
        stride = f"/{self.stride}" if self.stride > 1 else ""
        return (
            f"{self.kernel}x{self.kernel}{stride}, {self.inputs} to {self.outputs}, "
            f"{self.width} wide"
        )

    @property
    def result(self) -> int:
        """Height and width of the output."""
        return (self.width + 2 * self.padding - self.kernel) // self.stride + 1

    @property
    def repeats(self) -> bool:
        """Whether its output can be the input of another one."""
        return (self.inputs, self.width) == (self.outputs, self.result)

    @property
    def operations(self) -> float:
        """Arithmetic operations of a dense forward and backward pass."""
        return 6 * BATCH * self.kernel**2 * self.inputs * self.outputs * self.result**2


LAYERS = [
    *(
        Convolution(3, 1, 1, inputs, outputs, width)
        for inputs, outputs in ((32, 32), (32, 64), (64, 64))
        for width in (11, 21, 42, 84)
    ),
    Convolution(3, 1, 1, 4, 32, 84),
    Convolution(8, 4, 0, 4, 32, 84),
    Convolution(4, 2, 0, 32, 64, 20),
    Convolution(3, 1, 0, 64, 64, 9),
]
"""Layers of the Impala ResNet's kind, and those of the Nature CNN."""


def network(layer: Convolution, count: int, sparsity: float | None) -> th.nn.Sequential:
    """Make a chain of equal layers with ReLU.

    :param sparsity: of random masks; None: dense layers
    """
    found = th.nn.Sequential()
    for _ in range(count):
        shape = (layer.inputs, layer.outputs, layer.kernel, layer.stride, layer.padding)
        found.extend([th.nn.Conv2d(*shape), th.nn.ReLU()])
    if sparsity is None:
        return found
    random = np.random.default_rng(0)
    for convolution in found[::2]:
        size = convolution.weight.numel()
        flat = np.sort(random.choice(size, round(size * (1 - sparsity)), replace=False))
        structure = Structure(flat, (layer.outputs, size // layer.outputs))
        SparseConv2d.convert(convolution, structure, is_target=False)
    chain_up(found)
    return found


def passes(
    layer: Convolution, sparsities: list[float], chains: tuple[int, ...], bf16: bool
) -> dict[tuple[str, int], Callable[[], None]]:
    """Make forward and backward passes, by variant and length of the chain.

    The sparse variants are called ``sparse 0.9``. Images of four channels get no gradient: their
    layer is the first one of a network.
    """
    x = th.rand(BATCH, layer.inputs, layer.width, layer.width)
    x.requires_grad_(layer.inputs > 4)
    grad = th.randn(BATCH, layer.outputs, layer.result, layer.result)
    found = {}

    def add(name: str, count: int, sparsity: float | None, in_bf16: bool = False) -> None:
        chain = network(layer, count, sparsity)
        wanted = [tensor for tensor in (x, *chain.parameters()) if tensor.requires_grad]
        given = grad.bfloat16() if in_bf16 else grad

        def step() -> None:
            with th.autocast("cpu", dtype=th.bfloat16) if in_bf16 else nullcontext():
                y = chain(x)
            th.autograd.grad(y, wanted, given)

        found[name, count] = step

    for count in chains:
        add("dense", count, None)
        for sparsity in sparsities:
            add(f"sparse {sparsity}", count, sparsity)
    if bf16:
        add("dense bf16", 1, None, in_bf16=True)
    return found


def time_convolutions(
    layers: list[Convolution], sparsities: list[float], rounds: int, bf16: bool
) -> Iterator[dict[str, Any]]:
    """Time layers by themselves ("images") and between others of their kind ("maps").

    The time between others is that which four more layers add to a chain, divided by four. It is
    compared with the same time of dense layers.
    """
    for layer in layers:
        chains = (1, CHAIN) if layer.repeats else (1,)
        count = max(1, round(WORK / layer.operations))

        def repeated(step: Callable[[], None], count: int = count) -> Callable[[], None]:
            def run() -> None:
                for _ in range(count):
                    step()

            return run

        steps = passes(layer, sparsities, chains, bf16)
        named = {f"{name} x{length}": repeated(step) for (name, length), step in steps.items()}
        times = interleaved(named, rounds)
        for sparsity in sparsities:
            alone = {"dense": times["dense x1"], "sparse, images": times[f"sparse {sparsity} x1"]}
            if bf16:
                alone["dense bf16"] = times["dense bf16 x1"]
            yield from rows_of("conv", str(layer), BATCH, sparsity, alone, count)
            if layer.repeats:
                between = {
                    "dense": added(times["dense x1"], times[f"dense x{CHAIN}"]),
                    "sparse, maps": added(
                        times[f"sparse {sparsity} x1"], times[f"sparse {sparsity} x{CHAIN}"]
                    ),
                }
                _, row = rows_of("conv", str(layer), BATCH, sparsity, between, count)
                yield row


def added(one: list[float], chain: list[float]) -> list[float]:
    """Compute the time that each further layer of a chain takes, round by round."""
    return [(longer - shorter) / (CHAIN - 1) for shorter, longer in zip(one, chain, strict=True)]
