"""Forward and backward passes of images through a chain of sparse convolutions, for autograd."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import torch as th
from torch.nn import functional
from torch.nn.grad import conv2d_weight

from sb3_sparse.engine.activations import ADJUSTABLE, number_of
from sb3_sparse.engine.image_layout import LANES, Layout, Shape, lay_out
from sb3_sparse.engine.image_step import ImageStep
from sb3_sparse.engine.internals import is_batched
from sb3_sparse.engine.layer import dense_weight
from sb3_sparse.engine.native.library import (
    ImagesArgument,
    ImageStepArgument,
    MapArgument,
    library,
)
from sb3_sparse.engine.passes import Gradients, check_values, empty
from sb3_sparse.engine.reused import ReusedMemory
from sb3_sparse.engine.structure import Structure

FEW = 4
"""Up to so many images are computed one by one where no backward pass follows."""


class Call(NamedTuple):
    """What the kernels take of a chain for images of one size.

    :param layout: of the maps in memory
    :param maps: an array of ``map_t``
    :param arguments: an array of ``image_step_t``, without addresses
    """

    layout: Layout
    maps: Any
    arguments: Any


def prepare(steps: Sequence[ImageStep], shape: Shape, keep: bool) -> Call | None:
    """Prepare calls for images of a shape; None if the shape does not fit the steps.

    :param keep: whether a backward pass may follow
    """
    layout = lay_out(steps, shape, keep)
    if layout is None:
        return None
    maps = [MapArgument(*m.shape, m.kept, m.at, _number(m.grad_at)) for m in layout.maps]
    arguments = [
        ImageStepArgument(
            step.weight is None,
            step.input, step.source, step.output, _number(step.add), _number(step.copy),
            _number(back.gate), back.adds, back.slope,
            *chain.from_iterable(step.window), taken, *number_of(step.activation),
        )
        for step, taken, back in zip(steps, layout.taken, layout.backward, strict=True)
    ]  # fmt: skip
    return Call(
        layout,
        (MapArgument * len(maps))(*maps),
        (ImageStepArgument * len(arguments))(*arguments),
    )


def _number(number: int | None) -> int:
    return -1 if number is None else number


class ImagePass(NamedTuple):
    """One forward pass of a batch through a chain, and the backward pass if there is one.

    :param steps: the steps
    :param call: what the kernels take for images of this size
    :param structures: connections of each convolution
    :param layers: weak references to the convolutions
    :param batch: images of the batch
    :param memory: for the maps that the backward pass reads
    """

    steps: Sequence[ImageStep]
    call: Call
    structures: list[Structure]
    layers: list[Any]
    batch: int
    memory: ReusedMemory

    @property
    def keeps_result(self) -> bool:
        """Whether the backward pass reads the result: what it needs is among the kept maps."""
        return False

    def forward(self, x: th.Tensor, parameters: Sequence[Any]) -> tuple[th.Tensor, th.Tensor, Any]:
        """Compute the result, all that the backward pass reads, and nothing else."""
        layout = self.call.layout
        y = empty(self.batch, *layout.maps[self.steps[-1].output].shape)
        kept = self.memory(-(-self.batch // LANES) * layout.kept_size)
        images = self._images(layout.forward_size, kept, images_in=x.data_ptr())
        images.images_out = y.data_ptr()
        alone = not layout.kept_size and self.batch <= FEW
        self._run("one_by_one" if alone else "forward", images, self._arguments(parameters))
        return y, kept, None

    def backward(
        self,
        x: th.Tensor,
        kept: th.Tensor,
        parameters: Sequence[th.Tensor | None],
        needs: Sequence[bool],
        grad: th.Tensor,
        _: Any,
    ) -> list[th.Tensor | None]:
        """Compute the gradients as a :class:`~sb3_sparse.engine.passes.Pass` does.

        :param kept: the maps that :meth:`forward` kept
        """
        needs_x, *needed = needs
        arguments = self._arguments(parameters)
        numbers = [i for i, step in enumerate(self.steps) if step.weight is not None]
        steps = [self.steps[i] for i in numbers]
        shapes = [(self.batch, *self.call.layout.maps[step.output].shape) for step in steps]
        grads = Gradients(parameters, needed, self.layers, [arguments[i] for i in numbers], shapes)
        grad_x = th.empty_like(x) if needs_x else None
        images = self._images(self.call.layout.backward_size, kept, images_out_grad=grad.data_ptr())
        images.images_in_grad = 0 if grad_x is None else grad_x.data_ptr()
        self._run("backward", images, arguments)
        for i, listener, output_grad in grads.listening:
            listener.note(partial(self._outer, kept, steps[i], output_grad))
        return [grad_x, *grads.all]

    def by_dense_weights(self, x: th.Tensor, parameters: Sequence[Any]) -> th.Tensor:
        """Compute the same result by dense weights, which torch can differentiate repeatedly."""
        return by_dense_weights(self.steps, self.structures, x, parameters)

    def _images(self, scratch: int, kept: th.Tensor, **addresses: int) -> Any:
        layout = self.call.layout
        return ImagesArgument(
            steps=len(self.steps),
            maps=len(layout.maps),
            batch=self.batch,
            threads=th.get_num_threads(),
            ring=layout.ring,
            grad_ring=layout.grad_ring,
            kept_size=layout.kept_size,
            scratch_size=scratch,
            kept=kept.data_ptr() if layout.kept_size else 0,
            **addresses,
        )

    def _run(self, name: str, images: Any, arguments: Any) -> None:
        run = getattr(library(), f"sb3_sparse_images_{name}")
        if run(ctypes.byref(images), self.call.maps, arguments):
            raise MemoryError(f"no memory for the {name} pass of a chain of sparse convolutions")

    def _arguments(self, parameters: Sequence[Any]) -> Any:
        """An array of ``image_step_t``, without gradients."""
        arguments = type(self.call.arguments).from_buffer_copy(self.call.arguments)
        convolutions = zip(self.structures, parameters[::2], parameters[1::2], strict=True)
        for step, argument in zip(self.steps, arguments, strict=True):
            if step.weight is None:
                continue
            if isinstance(step.activation, ADJUSTABLE):
                argument.activation, argument.a, argument.b = number_of(step.activation)
            structure, values, bias = next(convolutions)
            check_values(structure, values, bias)
            argument.row_start, argument.column, *by_columns = structure.addresses
            argument.column_start, argument.row, argument.position = by_columns
            argument.value = values.data_ptr()
            argument.bias = 0 if bias is None else bias.data_ptr()
        return arguments

    def _outer(self, kept: th.Tensor, step: ImageStep, output_grad: th.Tensor) -> th.Tensor:
        """Compute a convolution's dense gradient from its kept input and its output's gradient."""
        shape, _, at, _ = self.call.layout.maps[step.input]
        channels, height, width = shape
        ring = self.call.layout.ring
        size = channels * (height + 2 * ring) * (width + 2 * ring) * LANES
        tiles = kept.view(-1, self.call.layout.kept_size)[:, at : at + size]
        x = tiles.view(-1, channels, height + 2 * ring, width + 2 * ring, LANES)
        x = x[:, :, ring : ring + height, ring : ring + width]
        x = x.permute(0, 4, 1, 2, 3).reshape(-1, *shape)[: self.batch]
        assert step.weight is not None
        grad: th.Tensor = conv2d_weight(x, step.weight, output_grad, *step.window[1:])  # type: ignore[no-untyped-call]
        return grad


def by_dense_weights(
    steps: Sequence[ImageStep],
    structures: Sequence[Structure],
    x: th.Tensor,
    parameters: Sequence[Any],
    layers: Sequence[Any] = (),
) -> th.Tensor:
    """Compute the result of a chain by dense weights.

    :param layers: weak references to the convolutions, whose listeners may want dense gradients
    """
    listening = iter(layers)
    maps = {0: x}
    convolutions = zip(structures, parameters[::2], parameters[1::2], strict=True)
    for step in steps:
        y = maps[step.input]
        if step.weight is None:
            y = functional.max_pool2d(y, *step.window)
        else:
            structure, values, bias = next(convolutions)
            weight = dense_weight(structure, values, step.weight)
            if (layer := next(listening, None)) is not None and weight.requires_grad:
                weight.register_hook(partial(_note, layer))  # type: ignore[no-untyped-call]
            y = functional.conv2d(y, weight, bias, *step.window[1:])
        if step.activation is not None:
            y = step.activation(y)
        maps[step.output] = y if step.add is None else y + maps[step.add]
        if step.copy is not None:
            maps[step.copy] = maps[step.output].relu()
    return maps[steps[-1].output]


def _note(layer: Any, grad: th.Tensor) -> None:
    """Give the gradient of a layer's dense weight to its listener."""
    listener = None if (module := layer()) is None else module.listener
    if th.is_grad_enabled() or is_batched(grad):
        return  # this pass is one of several, such as that of TRPO's KL divergence
    if listener is not None and listener.wanted():
        listener.note(partial(grad.clone, memory_format=th.contiguous_format))
