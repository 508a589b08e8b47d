"""What passes of rows and of images through sparse layers have in common."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, Protocol

import torch as th

from sb3_sparse.engine.layer import Listener, SparseLayer
from sb3_sparse.engine.native.library import readable
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import UnsupportedError

# The kernels read and write float32 on the CPU, whatever torch's defaults are.
empty = partial(th.empty, dtype=th.float32, device="cpu")


class Pass(Protocol):
    """One forward pass of a batch through a chain, and the backward pass if there is one."""

    @property
    def structures(self) -> Sequence[Structure]:
        """Connections of each layer."""

    @property
    def batch(self) -> int:
        """Entries of the batch."""

    @property
    def keeps_result(self) -> bool:
        """Whether the backward pass reads the result."""

    def forward(self, x: th.Tensor, parameters: Sequence[Any]) -> tuple[th.Tensor, th.Tensor, Any]:
        """Compute the result.

        :param x: the input, contiguous
        :param parameters: values and bias of each layer in turn
        :return: the result, and memory and arguments that :meth:`backward` takes
        """

    def backward(
        self,
        x: th.Tensor,
        kept: th.Tensor,
        parameters: Sequence[th.Tensor | None],
        needs: Sequence[bool],
        grad: th.Tensor,
        arguments: Any,
    ) -> list[th.Tensor | None]:
        """Compute the gradients of the input and of each parameter; None where not needed.

        :param x: as in :meth:`forward`, like ``parameters``
        :param kept: memory as :meth:`forward` left it
        :param needs: whether the gradient of the input and of each parameter is needed
        :param grad: gradient of the result, contiguous
        :param arguments: what :meth:`forward` returned last
        """

    def by_dense_weights(self, x: th.Tensor, parameters: Sequence[Any]) -> th.Tensor:
        """Compute the same result by dense weights, which torch can differentiate repeatedly."""


def as_float32(x: th.Tensor, columns: int | None = None) -> th.Tensor:
    """Return an input that autocast may have changed in an earlier layer as the kernels take it.

    :param columns: size that its last dimension must have; None: any
    :raises UnsupportedError: unless it is float32 on the CPU, and of that size
    """
    if x.is_floating_point() and th.is_autocast_enabled("cpu"):
        x = x.float()
    fits = columns is None or x.shape[-1:] == (columns,)
    if x.dtype != th.float32 or x.device.type != "cpu" or not fits:
        features = "" if columns is None else f" with {columns} features"
        raise UnsupportedError(
            f"a layer in sparse storage takes float32 on the CPU{features}, "
            f"got {x.dtype} on {x.device} of shape {tuple(x.shape)}; "
            "use compute='masked' for anything else"
        )
    return x


def read(layers: Iterable[SparseLayer], acting: bool) -> tuple[list[Structure], list[Any]]:
    """Read what a pass computes with: the connections, and values and bias, of each layer in turn.

    :param acting: whether another thread may move connections meanwhile, and no graph is needed
    """
    structures: list[Structure] = []
    parameters: list[Any] = []
    for layer in layers:
        structure, values = layer.held() if acting else layer.live()
        structures.append(structure)
        parameters += [values, layer.bias]
    return structures, parameters


def needs_graph(x: th.Tensor, parameters: Iterable[th.Tensor | None]) -> bool:
    """Whether torch wants the gradient of an input or of a parameter."""
    return th.is_grad_enabled() and (
        x.requires_grad or any(p is not None and p.requires_grad for p in parameters)
    )


def check_values(structure: Structure, values: th.Tensor, bias: th.Tensor | None) -> None:
    """Check that the kernels can read a layer's values and bias.

    :raises UnsupportedError: unless they are contiguous float32 on the CPU
    :raises RuntimeError: if another thread has moved the connections meanwhile
    """
    for parameter in (values, bias):
        if parameter is not None and not readable(parameter):
            raise UnsupportedError(
                "weights and biases of layers in sparse storage must be contiguous float32 "
                f"on the CPU, got {parameter.dtype} on {parameter.device} with strides "
                f"{parameter.stride()}"
            )
    if values.numel() != structure.nnz:
        raise RuntimeError("a layer's connections have changed while it was computing")


class Gradients:
    """Memory for the gradients of a chain's parameters, where the kernels write them.

    :param parameters: values and bias of each layer in turn
    :param needed: whether the gradient of each of them is needed
    :param layers: weak references to the layers, whose listeners may want dense gradients
    :param arguments: ``layer_t`` or ``image_step_t`` of each layer, which get the addresses
    :param shapes: of the gradient of each layer's output
    """

    def __init__(
        self,
        parameters: Sequence[th.Tensor | None],
        needed: Sequence[bool],
        layers: Sequence[Any],
        arguments: Iterable[Any],
        shapes: Iterable[Sequence[int]],
    ) -> None:
        self.all = [
            th.empty_like(parameter) if need and parameter is not None else None
            for parameter, need in zip(parameters, needed, strict=True)
        ]
        """The gradient of each parameter; None: not needed."""
        self.listening: list[tuple[int, Listener, th.Tensor]] = []
        """Layers whose dense gradient is wanted: number, listener and gradient of the output."""
        pairs = zip(self.all[::2], self.all[1::2], strict=True)
        for number, (layer, argument, shape, (of_values, of_bias)) in enumerate(
            zip(layers, arguments, shapes, pairs, strict=True)
        ):
            if of_bias is not None:
                argument.bias_grad = of_bias.data_ptr()
            if of_values is None:
                continue
            argument.value_grad = of_values.data_ptr()
            listener = None if (module := layer()) is None else module.listener
            if listener is not None and listener.wanted():
                output_grad = empty(*shape)
                argument.output_grad = output_grad.data_ptr()
                self.listening.append((number, listener, output_grad))
