"""Chains of sparse convolutions: one call of the kernels for each forward or backward pass."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from weakref import ref

import torch as th

from sb3_sparse.engine.chains import watched
from sb3_sparse.engine.image_layout import LANES
from sb3_sparse.engine.image_pass import FEW, ImagePass, by_dense_weights, prepare
from sb3_sparse.engine.image_step import ImageStep
from sb3_sparse.engine.layer import SparseLayer
from sb3_sparse.engine.passes import as_float32, needs_graph, read
from sb3_sparse.engine.products import Products
from sb3_sparse.engine.reused import ReusedMemory
from sb3_sparse.engine.structure import Structure

SIZES = 16
"""For so many sizes of images a chain stays prepared."""


def pays(batch: int, structures: Sequence[Structure]) -> bool:
    """Whether tiles of a batch are worth it, though lanes without an image compute as well.

    As for a full tile, what is computed must be at most half of what dense weights compute.

    :param structures: connections of each convolution
    """
    size = sum(rows * columns for rows, columns in (one.shape for one in structures))
    return batch >= LANES or 2 * LANES * sum(one.nnz for one in structures) <= batch * size


class ImageChain:
    """Sparse convolutions that follow each other, and what lies between them.

    :param steps: the steps
    :param layers: their convolutions
    """

    def __init__(self, steps: Sequence[ImageStep], layers: Sequence[SparseLayer]) -> None:
        self.steps = list(steps)
        self.activations = [step.activation for step in steps]
        self._layers = list(layers)
        # As for chains of linear layers: a graph must not hold the layers.
        self._references = [ref(layer) for layer in self._layers]
        self._call = lru_cache(SIZES)(partial(prepare, self.steps))
        self._memory = ReusedMemory()

    def __call__(self, x: th.Tensor) -> th.Tensor:
        """Apply the chain to images.

        :param x: shape (batch, channels, height, width), or without the batch
        :raises UnsupportedError: unless it is float32 on the CPU
        """
        if x.dim() == 3:
            return self(x[None])[0]
        x = as_float32(x)
        seen = watched(x)
        structures, parameters = read(self._layers, acting=not seen and not th.is_grad_enabled())
        trains = needs_graph(x, parameters)
        if seen:  # a tracer's sizes are no numbers
            return by_dense_weights(self.steps, structures, x, parameters)
        call = self._call(tuple(x.shape[1:]), trains) if x.dim() == 4 else None
        # Where sizes do not fit, torch says so.
        if call is None or not (pays(len(x), structures) or (len(x) <= FEW and not trains)):
            with th.autocast("cpu", enabled=False):  # float32, as by the kernels
                return by_dense_weights(self.steps, structures, x, parameters, self._references)
        how = ImagePass(self.steps, call, structures, self._references, len(x), self._memory)
        x = x.contiguous().resolve_neg()
        if trains:
            y: th.Tensor = Products.apply(how, x, *parameters)  # type: ignore[no-untyped-call]
            return y
        return how.forward(x, parameters)[0]
