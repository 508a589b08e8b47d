"""Runs of compact linear layers: one call of the kernels forward, one backward.

Between the layers of a run, and across elementwise activations to the next run, activations stay in
tiles: ``[ceil(batch / 64), features, 64]``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch as th
from torch.nn import functional

from sb3_sparse.engine.native.library import BatchArgument, library
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import UnsupportedError

if TYPE_CHECKING:
    from sb3_sparse.engine.linear import CompactLinear

TILE = 64
FIELDS = 14
VALUE_GRAD, BIAS_GRAD, OUTPUT_GRAD = 11, 12, 13
"""Places of a layer's fields in ``layer_t`` of ``kernels.h`` that only the way back fills."""


def tiles_of(batch: int) -> int:
    """Number of tiles of a batch."""
    return -(-batch // TILE)


class Chain:
    """Compact layers that follow each other, each perhaps with a ReLU.

    :param layers: the layers
    :param relus: whether a ReLU follows, for each
    """

    def __init__(self, layers: Sequence[CompactLinear], relus: Sequence[bool]) -> None:
        self.layers = list(layers)
        self.relus = list(relus)
        self.columns = self.layers[0].in_features
        self.rows = self.layers[-1].out_features
        self.widest = max(layer.out_features for layer in self.layers)

    def __call__(self, x: th.Tensor) -> th.Tensor:
        """The layers on ``x`` of shape ``(..., columns)``."""
        x, batch, lead = self.flattened(x)
        return self.run(x, batch, False, False).view(*lead, self.rows)

    def flattened(self, x: th.Tensor) -> tuple[th.Tensor, int, th.Size]:
        """The input as ``(batch, columns)``, its batch, and the dimensions it had before that.

        :raises UnsupportedError: for anything but float32 in main memory, ``columns`` wide
        """
        if x.dtype != th.float32 or x.device.type != "cpu" or x.shape[-1] != self.columns:
            raise UnsupportedError(
                f"a layer that computes on non-zeros takes float32 on the CPU with "
                f"{self.columns} features, got {x.dtype} on {x.device} of shape {tuple(x.shape)}; "
                "use compute='masked' for anything else"
            )
        lead = x.shape[:-1]
        x = x.reshape(-1, self.columns).contiguous()
        return x, x.shape[0], lead

    def run(self, x: th.Tensor, batch: int, tiled_in: bool, tiled_out: bool) -> th.Tensor:
        """The layers on rows ``(batch, columns)`` or tiles, giving rows or tiles."""
        structures, parameters = [], []
        for layer in self.layers:
            structure, values = layer.live()
            structures.append(structure)
            parameters += [values, layer.bias]
        if th.is_grad_enabled() and (
            x.requires_grad or any(p is not None and p.requires_grad for p in parameters)
        ):
            how = (self, structures, batch, tiled_in, tiled_out)
            y: th.Tensor = _Products.apply(how, x, *parameters)  # type: ignore[no-untyped-call]
            return y
        if batch == 1 and not tiled_in and not tiled_out:
            return self._single(structures, parameters, x)
        return self._forward(structures, parameters, x, batch, tiled_in, tiled_out)[0]

    def _arguments(
        self, structures: Sequence[Structure], parameters: Sequence[Any], outputs: Sequence[int]
    ) -> list[int]:
        """``layer_t`` of every layer, without the gradients."""
        arguments = []
        for i, structure in enumerate(structures):
            bias = parameters[2 * i + 1]
            arguments += [
                *structure.shape,
                self.relus[i],
                *structure.addresses,
                parameters[2 * i].data_ptr(),
                0 if bias is None else bias.data_ptr(),
                outputs[i],
                0,
                0,
                0,
            ]
        return arguments

    def _single(
        self, structures: Sequence[Structure], parameters: Sequence[Any], x: th.Tensor
    ) -> th.Tensor:
        y = th.empty(1, self.rows)
        spare = th.empty(2 * self.widest)
        arguments = self._arguments(structures, parameters, [0] * len(structures))
        library().sb3_sparse_single(
            (ctypes.c_int64 * len(arguments))(*arguments),
            len(structures),
            x.data_ptr(),
            spare.data_ptr(),
            y.data_ptr(),
        )
        return y

    def _forward(
        self,
        structures: Sequence[Structure],
        parameters: Sequence[Any],
        x: th.Tensor,
        batch: int,
        tiled_in: bool,
        tiled_out: bool,
    ) -> tuple[th.Tensor, th.Tensor, list[int]]:
        """Result, workspace with all activations in tiles (but a tiled result), and arguments."""
        tiles = tiles_of(batch)
        kept = 0 if tiled_in else self.columns
        widths = [structure.shape[0] for structure in structures]
        y = th.empty((tiles, self.rows, TILE) if tiled_out else (batch, self.rows))
        work = th.empty(tiles * TILE * (kept + sum(widths[:-1]) + (not tiled_out) * self.rows))
        start = work.data_ptr()
        outputs = []
        at = kept
        for width in widths:
            outputs.append(start + 4 * tiles * TILE * at)
            at += width
        if tiled_out:
            outputs[-1] = y.data_ptr()
        arguments = self._arguments(structures, parameters, outputs)
        how = BatchArgument(
            layers=len(structures),
            batch=batch,
            threads=th.get_num_threads(),
            input=x.data_ptr() if tiled_in else start,
            rows_in=0 if tiled_in else x.data_ptr(),
            rows_out=0 if tiled_out else y.data_ptr(),
        )
        library().sb3_sparse_forward(
            (ctypes.c_int64 * len(arguments))(*arguments), ctypes.byref(how)
        )
        return y, work, arguments

    def _inputs(self, x: th.Tensor, work: th.Tensor, y: th.Tensor, tiled_in: bool) -> list[Any]:
        """Each layer's input in tiles, as the way forth left it."""
        tiles = x.shape[0] if tiled_in else tiles_of(x.shape[0])
        at = 0
        inputs = []
        if tiled_in:
            inputs.append(x)
        for layer in self.layers:
            if len(inputs) == len(self.layers):
                break
            width = layer.in_features if not inputs else 0
            width = width or self.layers[len(inputs) - 1].out_features
            size = tiles * TILE * width
            inputs.append(work[at : at + size].view(tiles, width, TILE))
            at += size
        return inputs


class _Products(th.autograd.Function):
    """A chain on a batch, differentiable by its input, values and biases."""

    @staticmethod
    def forward(ctx: Any, how: Any, x: th.Tensor, *parameters: Any) -> th.Tensor:
        chain, structures, batch, tiled_in, tiled_out = how
        y: th.Tensor
        y, work, arguments = chain._forward(structures, parameters, x, batch, tiled_in, tiled_out)
        ctx.how, ctx.arguments = how, arguments
        # A tiled result is part of what the way back needs; as an output it may be saved.
        ctx.save_for_backward(x, work, y if tiled_out else None, *parameters)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        (grad,) = gradients
        chain, structures, batch, tiled_in, tiled_out = ctx.how
        x, work, y, *parameters = ctx.saved_tensors
        needs_x, *needs = ctx.needs_input_grad[1:]
        if th.is_grad_enabled():  # the gradient shall itself be differentiable
            wanted = [
                p for p, need in zip((x, *parameters), (needs_x, *needs), strict=True) if need
            ]
            result = _by_dense_weights(chain, structures, batch, tiled_in, tiled_out, x, parameters)
            found = iter(th.autograd.grad(result, wanted, grad, create_graph=True))
            return None, *(next(found) if need else None for need in (needs_x, *needs))
        grad = grad.contiguous()
        arguments = list(ctx.arguments)
        grads: list[th.Tensor | None] = []
        for i, (parameter, need) in enumerate(zip(parameters, needs, strict=True)):
            grads.append(th.empty_like(parameter) if need else None)
            if need:
                field = BIAS_GRAD if i % 2 else VALUE_GRAD
                arguments[FIELDS * (i // 2) + field] = grads[i].data_ptr()  # type: ignore[union-attr]
        listening: dict[int, th.Tensor] = {}
        for i, layer in enumerate(chain.layers):
            if needs[2 * i] and layer.listener is not None and layer.listener.wanted():
                listening[i] = th.empty(tiles_of(batch), layer.out_features, TILE)
                arguments[FIELDS * i + OUTPUT_GRAD] = listening[i].data_ptr()
        grad_x = th.empty_like(x) if needs_x else None
        to = 0 if grad_x is None else grad_x.data_ptr()
        how = BatchArgument(
            layers=len(structures),
            batch=batch,
            threads=th.get_num_threads(),
            input=x.data_ptr() if tiled_in else work.data_ptr(),
            rows_grad=0 if tiled_out else grad.data_ptr(),
            tiles_grad=grad.data_ptr() if tiled_out else 0,
            rows_input_grad=0 if tiled_in else to,
            tiles_input_grad=to if tiled_in else 0,
        )
        failed = library().sb3_sparse_backward(
            (ctypes.c_int64 * len(arguments))(*arguments), ctypes.byref(how)
        )
        if failed:
            raise MemoryError("no memory for the gradient of a chain of compact layers")
        if listening:
            inputs = chain._inputs(x, work, y, tiled_in)
            for i, output_grad in listening.items():
                chain.layers[i].listener.note(_outer(output_grad, inputs[i], batch))
        return None, grad_x, *grads


def _outer(output_grad: th.Tensor, x: th.Tensor, batch: int) -> th.Tensor:
    """Dense gradient of a layer's weight, from tiles of its output's gradient and its input."""
    total = th.zeros(output_grad.shape[1], x.shape[1])
    for t in range(len(x)):
        entries = min(TILE, batch - t * TILE)
        total.addmm_(output_grad[t, :, :entries], x[t, :, :entries].T)
    return total


def _by_dense_weights(
    chain: Chain,
    structures: Sequence[Structure],
    batch: int,
    tiled_in: bool,
    tiled_out: bool,
    x: th.Tensor,
    parameters: Sequence[Any],
) -> th.Tensor:
    """The same result by dense weights, which torch differentiates as often as one likes.

    Only TRPO asks for it.
    """
    if tiled_in:
        x = x.transpose(1, 2).reshape(-1, chain.columns)[:batch]
    for i, structure in enumerate(structures):
        rows, columns = structure.shape
        flat = th.from_numpy(structure.flat)
        weight = th.zeros(rows * columns).index_put((flat,), parameters[2 * i])
        x = functional.linear(x, weight.view(rows, columns), parameters[2 * i + 1])
        if chain.relus[i]:
            x = functional.relu(x)
    if tiled_out:
        x = functional.pad(x, (0, 0, 0, tiles_of(batch) * TILE - batch))
        x = x.view(-1, TILE, chain.rows).transpose(1, 2)
    return x
