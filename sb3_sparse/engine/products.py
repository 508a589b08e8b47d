"""Forward and backward passes through a chain of layers, for autograd.

Between the layers of a chain, and across elementwise activations to the next chain, activations
stay in tiles: ``[ceil(batch / 64), features, 64]``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.nn import functional

from sb3_sparse.engine.activations import number_of
from sb3_sparse.engine.internals import is_batched
from sb3_sparse.engine.layer import dense_weight
from sb3_sparse.engine.native.library import BatchArgument, LayerArgument, library
from sb3_sparse.engine.passes import Gradients, Pass, check_values, empty
from sb3_sparse.engine.structure import Structure

TILE = 64


def _tiles(batch: int, features: int) -> th.Tensor:
    """Memory for a batch in tiles; the unused end of the last tile is 0, in case it is read."""
    tiles = empty(tiles_of(batch), features, TILE)
    if batch % TILE:
        tiles[-1].zero_()
    return tiles


def tiles_of(batch: int) -> int:
    """Number of tiles of a batch."""
    return -(-batch // TILE)


class ChainPass(NamedTuple):
    """One forward pass of a batch through a chain, and the backward pass if there is one.

    :param activations: activation after each layer; None: there is none
    :param structures: connections of each layer
    :param layers: weak references to the layers
    :param batch: entries of the batch
    :param tiled_in: whether the input comes in tiles
    :param tiled_out: whether the result is in tiles
    """

    activations: list[nn.Module | None]
    structures: list[Structure]
    layers: list[Any]
    batch: int
    tiled_in: bool
    tiled_out: bool

    @property
    def columns(self) -> int:
        return self.structures[0].shape[1]

    @property
    def rows(self) -> int:
        return self.structures[-1].shape[0]

    @property
    def keeps_result(self) -> bool:
        """Whether the backward pass reads the result: a tiled one that an activation made."""
        return self.tiled_out and self.activations[-1] is not None

    def _arguments(self, parameters: Sequence[Any], outputs: Sequence[int]) -> Any:
        """An array of ``layer_t``, without the gradients.

        :param parameters: values and bias of each layer
        :param outputs: address of each layer's output
        """
        arguments: list[LayerArgument] = []
        for structure, activation, values, bias, output in zip(
            self.structures, self.activations, parameters[::2], parameters[1::2], outputs,
            strict=True,
        ):  # fmt: skip
            check_values(structure, values, bias)
            bias_at = 0 if bias is None else bias.data_ptr()
            arguments.append(
                LayerArgument(
                    *structure.shape, *number_of(activation), *structure.addresses,
                    values.data_ptr(), bias_at, output,
                )
            )  # fmt: skip
        return (LayerArgument * len(arguments))(*arguments)

    def forward(self, x: th.Tensor, parameters: Sequence[Any]) -> tuple[th.Tensor, th.Tensor, Any]:
        """The result, all other activations in tiles, and the array of ``layer_t``."""
        tiles = tiles_of(self.batch)
        widths = self._widths()
        y = _tiles(self.batch, self.rows) if self.tiled_out else empty(self.batch, self.rows)
        work = empty(tiles * TILE * sum(widths))
        start = at = work.data_ptr()
        places = []
        for width in widths:
            places.append(at)
            at += 4 * tiles * TILE * width
        outputs = places[0 if self.tiled_in else 1 :]
        if self.tiled_out:
            outputs.append(y.data_ptr())
        arguments = self._arguments(parameters, outputs)
        batch = BatchArgument(
            layers=len(self.structures),
            batch=self.batch,
            threads=th.get_num_threads(),
            input=x.data_ptr() if self.tiled_in else start,
            rows_in=0 if self.tiled_in else x.data_ptr(),
            rows_out=0 if self.tiled_out else y.data_ptr(),
        )
        library().sb3_sparse_forward(arguments, ctypes.byref(batch))
        return y, work, arguments

    def backward(
        self,
        x: th.Tensor,
        work: th.Tensor,
        parameters: Sequence[th.Tensor | None],
        needs: Sequence[bool],
        grad: th.Tensor,
        arguments: Any,
    ) -> list[th.Tensor | None]:
        """Compute the gradients as a :class:`~sb3_sparse.engine.passes.Pass` does.

        :param work: activations as :meth:`forward` left them
        :param arguments: the array of ``layer_t`` that :meth:`forward` made
        """
        arguments = type(arguments).from_buffer_copy(arguments)
        needs_x, *needed = needs
        shapes = [(tiles_of(self.batch), argument.rows, TILE) for argument in arguments]
        grads = Gradients(parameters, needed, self.layers, arguments, shapes)
        grad_x = None
        if needs_x:
            grad_x = _tiles(self.batch, self.columns) if self.tiled_in else th.empty_like(x)
        to = 0 if grad_x is None else grad_x.data_ptr()
        batch = BatchArgument(
            layers=len(self.structures),
            batch=self.batch,
            threads=th.get_num_threads(),
            input=x.data_ptr() if self.tiled_in else work.data_ptr(),
            rows_grad=0 if self.tiled_out else grad.data_ptr(),
            tiles_grad=grad.data_ptr() if self.tiled_out else 0,
            rows_input_grad=0 if self.tiled_in else to,
            tiles_input_grad=to if self.tiled_in else 0,
        )
        if library().sb3_sparse_backward(arguments, ctypes.byref(batch)):
            raise MemoryError("no memory for the gradient of a chain of sparse layers")
        inputs = self._inputs(x, work) if grads.listening else []
        for i, listener, output_grad in grads.listening:
            listener.note(partial(_outer, output_grad, inputs[i], self.batch))
        return [grad_x, *grads.all]

    def _widths(self) -> list[int]:
        """Features of each array in the workspace: input and outputs without those in tiles."""
        widths = [self.columns, *(structure.shape[0] for structure in self.structures)]
        return widths[1 if self.tiled_in else 0 : -1 if self.tiled_out else None]

    def _inputs(self, x: th.Tensor, work: th.Tensor) -> list[th.Tensor]:
        """Each layer's input in tiles, as the forward pass left it."""
        tiles = tiles_of(self.batch)
        widths = self._widths()
        parts = th.split(work, [tiles * TILE * width for width in widths])
        shaped = [part.view(tiles, width, TILE) for part, width in zip(parts, widths, strict=True)]
        return ([x, *shaped] if self.tiled_in else shaped)[: len(self.structures)]

    def by_dense_weights(self, x: th.Tensor, parameters: Sequence[Any]) -> th.Tensor:
        """Compute the same result by dense weights, which torch can differentiate repeatedly."""
        if self.tiled_in:
            x = x.transpose(1, 2).reshape(-1, self.columns)[: self.batch]
        for i, structure in enumerate(self.structures):
            weight = dense_weight(structure, parameters[2 * i], structure.shape)
            x = functional.linear(x, weight, parameters[2 * i + 1])
            if (activation := self.activations[i]) is not None:
                x = activation(x)
        if self.tiled_out:
            x = functional.pad(x, (0, 0, 0, tiles_of(self.batch) * TILE - self.batch))
            x = x.view(-1, TILE, self.rows).transpose(1, 2)
        return x


class Products(th.autograd.Function):
    """Applies a chain to a batch, differentiable by its input, values and biases."""

    @staticmethod
    def forward(ctx: Any, how: Pass, x: th.Tensor, *parameters: Any) -> th.Tensor:
        y, work, arguments = how.forward(x, parameters)
        ctx.how, ctx.arguments = how, arguments
        # Where the backward pass does not read the result, an activation that works in place may
        # change it.
        kept = y if how.keeps_result else None
        ctx.save_for_backward(x, work, kept, *parameters)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        how: Pass = ctx.how
        x, work, _, *parameters = ctx.saved_tensors
        needs = ctx.needs_input_grad[1:]
        # TRPO needs a differentiable gradient, and torch.func several at once.
        again = th.is_grad_enabled()
        if again or is_batched(gradients[0]):
            with th.enable_grad():
                result = how.by_dense_weights(x, parameters)
            wanted = [tensor for tensor, need in zip((x, *parameters), needs, strict=True) if need]
            found = iter(th.autograd.grad(result, wanted, gradients, create_graph=again))
            return None, *(next(found) if need else None for need in needs)
        for structure, values in zip(how.structures, parameters[::2], strict=True):
            if values.numel() != structure.nnz:
                raise RuntimeError(
                    "a layer's connections have changed between its forward and its backward pass"
                )
        if how.batch == 0:
            tensors = zip((x, *parameters), needs, strict=True)
            return None, *(th.zeros_like(tensor) if need else None for tensor, need in tensors)
        grad = gradients[0].contiguous().resolve_neg()
        return None, *how.backward(x, work, parameters, needs, grad, ctx.arguments)


def _outer(output_grad: th.Tensor, x: th.Tensor, batch: int) -> th.Tensor:
    """Compute a weight's dense gradient from tiles of its layer's output gradient and input."""
    total = x.new_zeros(output_grad.shape[1], x.shape[1])
    for t in range(len(x)):
        entries = min(TILE, batch - t * TILE)
        total.addmm_(output_grad[t, :, :entries], x[t, :, :entries].T)
    return total
