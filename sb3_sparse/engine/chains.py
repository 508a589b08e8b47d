"""Chains of sparse linear layers: one call of the kernels for each forward or backward pass."""

from __future__ import annotations

from collections.abc import Sequence
from weakref import ref

import torch as th
from torch import nn

from sb3_sparse.engine.internals import watching
from sb3_sparse.engine.layer import SparseLayer
from sb3_sparse.engine.passes import as_float32, needs_graph, read
from sb3_sparse.engine.products import ChainPass, Products

PLAIN = (th.Tensor, th.nn.Parameter)


class Chain:
    """Sparse layers that follow each other, with or without activations.

    :param layers: the layers
    :param activations: the activation after each layer, whose slope follows from its result; None:
        no activation
    """

    def __init__(
        self, layers: Sequence[SparseLayer], activations: Sequence[nn.Module | None]
    ) -> None:
        self.layers = list(layers)
        self.activations = list(activations)
        self.columns = self.layers[0].structure.shape[1]
        self.rows = self.layers[-1].structure.shape[0]
        # A graph must not hold the layers: Python's garbage collector cannot see through it, and
        # SB3's action distributions keep the last one.
        self._references = [ref(layer) for layer in self.layers]

    def __call__(self, x: th.Tensor) -> th.Tensor:
        """Apply the layers to ``x`` of shape ``(..., columns)``."""
        x, batch, lead = self.flattened(x)
        return self.run(x, batch, False, False).view(*lead, self.rows)

    def flattened(self, x: th.Tensor) -> tuple[th.Tensor, int, th.Size]:
        """Flatten the input to ``(batch, columns)``; return batch and leading dimensions too.

        :raises UnsupportedError: unless it is float32 on the CPU and ``columns`` wide
        """
        x = as_float32(x, self.columns)
        lead = x.shape[:-1]
        x = x.reshape(-1, self.columns).contiguous().resolve_neg()
        return x, x.shape[0], lead

    def run(self, x: th.Tensor, batch: int, tiled_in: bool, tiled_out: bool) -> th.Tensor:
        """Apply the layers to rows ``(batch, columns)`` or tiles; the result is rows or tiles."""
        seen = watched(x)
        structures, parameters = read(self.layers, acting=not seen and not th.is_grad_enabled())
        how = ChainPass(self.activations, structures, self._references, batch, tiled_in, tiled_out)
        if seen:
            return how.by_dense_weights(x, parameters)
        if needs_graph(x, parameters):
            y: th.Tensor = Products.apply(how, x, *parameters)  # type: ignore[no-untyped-call]
            return y
        return how.forward(x, parameters)[0]


def watched(x: th.Tensor) -> bool:
    """Whether ``x`` or a mode of torch observes single operations, e.g. as fake tensors do."""
    return type(x) not in PLAIN or watching()
