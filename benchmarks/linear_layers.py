"""Single linear layers for sparse_compute.py: forward and backward, dense and sparse."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th
from compute_rows import rows_of
from rounds import interleaved
from torch.nn import functional

from sb3_sparse.engine.chains import Chain
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.products import TILE, tiles_of
from sb3_sparse.engine.structure import Structure


def layer_steps(width: int, batch: int, sparsity: float) -> dict[str, Callable[[], Any]]:
    """Make forward and backward passes of a square layer with ReLU, dense and sparse."""
    random = np.random.default_rng(0)
    nnz = round(width * width * (1 - sparsity))
    flat = np.sort(random.choice(width * width, nnz, replace=False))
    dense, twin = th.nn.Linear(width, width), th.nn.Linear(width, width)
    x = th.randn(batch, width, requires_grad=True)
    grad = th.randn(batch, width)
    layer = SparseLinear.convert(twin, Structure(flat, (width, width)), is_target=False)
    chain = Chain([layer], [th.nn.ReLU()])
    tiles = th.randn(tiles_of(batch), width, TILE, requires_grad=True)
    tiles_grad = th.randn(tiles_of(batch), width, TILE)
    csr = th.zeros(width * width)
    csr[flat] = layer.weight.detach()
    with_csr = csr.view(width, width).to_sparse_csr().requires_grad_(True)
    turned = x.detach().T.contiguous().requires_grad_(True)

    def backward(y: th.Tensor, inputs: list[th.Tensor], grad: th.Tensor) -> None:
        th.autograd.grad(y, inputs, grad)

    def in_bf16() -> None:
        with th.autocast("cpu", dtype=th.bfloat16):
            y = functional.relu(functional.linear(x, dense.weight, dense.bias))
        backward(y, [x, *dense.parameters()], grad.bfloat16())

    return {
        "dense": lambda: backward(
            functional.relu(functional.linear(x, dense.weight, dense.bias)),
            [x, *dense.parameters()],
            grad,
        ),
        "sparse, tiles": lambda: backward(
            chain.run(tiles, batch, True, True), [tiles, *layer.parameters()], tiles_grad
        ),
        "sparse, rows": lambda: backward(chain(x), [x, *layer.parameters()], grad),
        "torch CSR": lambda: backward(
            functional.relu(with_csr @ turned + layer.bias[:, None]),
            [turned, with_csr, layer.bias],
            grad.T.contiguous(),
        ),
        "dense bf16": in_bf16,
    }


def time_layers(
    widths: list[int], sparsities: list[float], rounds: int
) -> Iterator[dict[str, Any]]:
    """Time square layers at batch sizes of 32 and 256."""
    for width in widths:
        for batch in (32, 256):
            for sparsity in sparsities:
                steps = layer_steps(width, batch, sparsity)
                inner = max(5, round(2e8 / (6 * width * width * batch)))
                repeated = {
                    name: (lambda step=step, inner=inner: [step() for _ in range(inner)])
                    for name, step in steps.items()
                }
                times = interleaved(repeated, rounds)
                yield from rows_of("layer", f"{width}x{width}", batch, sparsity, times, inner)
