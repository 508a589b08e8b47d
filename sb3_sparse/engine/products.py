"""What the kernels compute, for autograd: a batch through a chain of layers and back.

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
from sb3_sparse.engine.native.library import BatchArgument, bits_of, library, readable
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import UnsupportedError

TILE = 64
FIELDS = 16
VALUE_GRAD, BIAS_GRAD, OUTPUT_GRAD = 13, 14, 15
"""Places of a layer's fields in ``layer_t`` of ``kernels.h`` that only the way back fills."""


# Whatever torch's defaults are: the kernels read and write this and nothing else.
_empty = partial(th.empty, dtype=th.float32, device="cpu")


def _tiles(batch: int, features: int) -> th.Tensor:
    """Room for a batch in tiles; what fills up the last one is 0, lest somebody looks at it."""
    tiles = _empty(tiles_of(batch), features, TILE)
    if batch % TILE:
        tiles[-1].zero_()
    return tiles


def tiles_of(batch: int) -> int:
    """Number of tiles of a batch."""
    return -(-batch // TILE)


class ChainPass(NamedTuple):
    """One way forth, and perhaps back, of a batch through a chain."""

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

    def arguments(self, parameters: Sequence[Any], outputs: Sequence[int]) -> list[int]:
        """``layer_t`` of every layer, without the gradients."""
        arguments: list[int] = []
        for i, structure in enumerate(self.structures):
            values, bias = parameters[2 * i : 2 * i + 2]
            for parameter in (values, bias):
                if parameter is not None and not readable(parameter):
                    raise UnsupportedError(
                        "weights and biases of layers in sparse storage must be "
                        f"contiguous float32 on the CPU, got {parameter.dtype} on "
                        f"{parameter.device} with strides {parameter.stride()}"
                    )
            if values.numel() != structure.nnz:
                raise RuntimeError("a layer's connections have changed while it was computing")
            kind, a, b = number_of(self.activations[i])
            arguments += (
                *structure.shape,
                kind,
                bits_of(a),
                bits_of(b),
                *structure.addresses,
                values.data_ptr(),
                0 if bias is None else bias.data_ptr(),
                outputs[i],
                0,
                0,
                0,
            )
        return arguments

    def forward(
        self, x: th.Tensor, parameters: Sequence[Any]
    ) -> tuple[th.Tensor, th.Tensor, list[int]]:
        """Result, workspace with all activations in tiles (but a tiled result), and arguments."""
        tiles = tiles_of(self.batch)
        widths = self._widths()
        y = _tiles(self.batch, self.rows) if self.tiled_out else _empty(self.batch, self.rows)
        work = _empty(tiles * TILE * sum(widths))
        start = at = work.data_ptr()
        places = []
        for width in widths:
            places.append(at)
            at += 4 * tiles * TILE * width
        outputs = places[0 if self.tiled_in else 1 :]
        if self.tiled_out:
            outputs.append(y.data_ptr())
        arguments = self.arguments(parameters, outputs)
        how = BatchArgument(
            layers=len(self.structures),
            batch=self.batch,
            threads=th.get_num_threads(),
            input=x.data_ptr() if self.tiled_in else start,
            rows_in=0 if self.tiled_in else x.data_ptr(),
            rows_out=0 if self.tiled_out else y.data_ptr(),
        )
        library().sb3_sparse_forward(
            (ctypes.c_int64 * len(arguments))(*arguments), ctypes.byref(how)
        )
        return y, work, arguments

    def _widths(self) -> list[int]:
        """Features of what the workspace holds: the input and each output, but what is tiled."""
        widths = [self.columns, *(structure.shape[0] for structure in self.structures)]
        return widths[1 if self.tiled_in else 0 : -1 if self.tiled_out else None]

    def inputs(self, x: th.Tensor, work: th.Tensor) -> list[th.Tensor]:
        """Each layer's input in tiles, as the way forth left it."""
        tiles = tiles_of(self.batch)
        widths = self._widths()
        parts = th.split(work, [tiles * TILE * width for width in widths])
        shaped = [part.view(tiles, width, TILE) for part, width in zip(parts, widths, strict=True)]
        return ([x, *shaped] if self.tiled_in else shaped)[: len(self.structures)]

    def by_dense_weights(self, x: th.Tensor, parameters: Sequence[Any]) -> th.Tensor:
        """The same result by dense weights, which torch differentiates as often as one likes."""
        if self.tiled_in:
            x = x.transpose(1, 2).reshape(-1, self.columns)[: self.batch]
        for i, structure in enumerate(self.structures):
            rows, columns = structure.shape
            flat = th.from_numpy(structure.flat)
            values = parameters[2 * i]
            if th.onnx.is_in_onnx_export():
                # Its tracer knows the dense weights of the state_dict, not these values.
                values = values.data
            weight = values.new_zeros(rows * columns).index_put((flat,), values)
            x = functional.linear(x, weight.view(rows, columns), parameters[2 * i + 1])
            if (activation := self.activations[i]) is not None:
                x = activation(x)
        if self.tiled_out:
            x = functional.pad(x, (0, 0, 0, tiles_of(self.batch) * TILE - self.batch))
            x = x.view(-1, TILE, self.rows).transpose(1, 2)
        return x


class Products(th.autograd.Function):
    """A chain on a batch, differentiable by its input, values and biases."""

    @staticmethod
    def forward(ctx: Any, how: ChainPass, x: th.Tensor, *parameters: Any) -> th.Tensor:
        y, work, arguments = how.forward(x, parameters)
        ctx.how, ctx.arguments = how, arguments
        # A tiled result is looked at on the way back where an activation made it. Where none did,
        # one that works in place may change it.
        kept = y if how.tiled_out and how.activations[-1] is not None else None
        ctx.save_for_backward(x, work, kept, *parameters)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        how: ChainPass = ctx.how
        x, work, _, *parameters = ctx.saved_tensors
        needs_x, *needs = ctx.needs_input_grad[1:]
        pairs = list(zip((x, *parameters), (needs_x, *needs), strict=True))
        # The gradient shall itself be differentiable (TRPO asks for it), or is many at once.
        again = th.is_grad_enabled()
        if again or _many(gradients[0]):
            with th.enable_grad():
                result = how.by_dense_weights(x, parameters)
            wanted = [tensor for tensor, need in pairs if need]
            found = iter(th.autograd.grad(result, wanted, gradients, create_graph=again))
            return None, *(next(found) if need else None for _, need in pairs)
        for structure, values in zip(how.structures, parameters[::2], strict=True):
            if values.numel() != structure.nnz:
                raise RuntimeError(
                    "a layer's connections have changed between its forward and its backward pass"
                )
        if how.batch == 0:
            return None, *(th.zeros_like(tensor) if need else None for tensor, need in pairs)
        grad = gradients[0].contiguous().resolve_neg()
        arguments = list(ctx.arguments)
        grads: list[th.Tensor | None] = []
        for i, (parameter, need) in enumerate(zip(parameters, needs, strict=True)):
            made = th.empty_like(parameter) if need else None
            grads.append(made)
            if made is not None:
                field = BIAS_GRAD if i % 2 else VALUE_GRAD
                arguments[FIELDS * (i // 2) + field] = made.data_ptr()
        listening: list[tuple[int, Any, th.Tensor]] = []
        for i, reference in enumerate(how.layers):
            listener = None if (layer := reference()) is None else layer.listener
            if needs[2 * i] and listener is not None and listener.wanted():
                left = _empty(tiles_of(how.batch), how.structures[i].shape[0], TILE)
                arguments[FIELDS * i + OUTPUT_GRAD] = left.data_ptr()
                listening.append((i, listener, left))
        grad_x = None
        if needs_x:
            grad_x = _tiles(how.batch, how.columns) if how.tiled_in else th.empty_like(x)
        to = 0 if grad_x is None else grad_x.data_ptr()
        argument = BatchArgument(
            layers=len(how.structures),
            batch=how.batch,
            threads=th.get_num_threads(),
            input=x.data_ptr() if how.tiled_in else work.data_ptr(),
            rows_grad=0 if how.tiled_out else grad.data_ptr(),
            tiles_grad=grad.data_ptr() if how.tiled_out else 0,
            rows_input_grad=0 if how.tiled_in else to,
            tiles_input_grad=to if how.tiled_in else 0,
        )
        failed = library().sb3_sparse_backward(
            (ctypes.c_int64 * len(arguments))(*arguments), ctypes.byref(argument)
        )
        if failed:
            raise MemoryError("no memory for the gradient of a chain of sparse layers")
        inputs = how.inputs(x, work) if listening else []
        for i, listener, left in listening:
            listener.note(partial(_outer, left, inputs[i], how.batch))
        return None, grad_x, *grads


def _many(gradient: th.Tensor) -> bool:
    """Whether it stands for several gradients at once: ``is_grads_batched``, ``torch.func``."""
    kinds = th._C._functorch
    return bool(kinds.is_legacy_batchedtensor(gradient) or kinds.is_batchedtensor(gradient))


def _outer(output_grad: th.Tensor, x: th.Tensor, batch: int) -> th.Tensor:
    """Dense gradient of a layer's weight, from tiles of its output's gradient and its input."""
    total = x.new_zeros(output_grad.shape[1], x.shape[1])
    for t in range(len(x)):
        entries = min(TILE, batch - t * TILE)
        total.addmm_(output_grad[t, :, :entries], x[t, :, :entries].T)
    return total
