"""Base class of the layers that store and compute their active connections only."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import torch as th
from torch import nn

from sb3_sparse.engine.internals import become, replace_data
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import UnsupportedError

MASK_KEY = "weight_mask"
TRIES = 100
"""How often to read a layer again whose connections another thread is moving."""

Layer = TypeVar("Layer", bound="SparseLayer")


class Listener(Protocol):
    """Asks for a layer's dense gradient before mask updates."""

    def wanted(self) -> bool:
        """Whether it needs the dense gradient of this backward pass."""

    def note(self, dense_grad: Callable[[], th.Tensor]) -> None:
        """Take a function that computes it, in the weight's dense shape."""


class Snapshot(NamedTuple):
    """The weights that a hard target uses between a mask update and its next copy.

    :param structure: its connections before the update
    :param values: their weights, shape ``(structure.nnz,)``
    :param placed: the content of its Parameter since the update: ``values`` where the new mask has
        them, else 0. Any other content means that the Parameter has been written.
    """

    structure: Structure
    values: th.Tensor
    placed: th.Tensor


class SparseLayer(nn.Module):
    """Base class of layers whose Parameter ``weight`` holds the values of the active connections.

    The Parameter has shape ``(nnz,)``; ``structure`` gives the indices, those of the dense weight
    as a matrix with a row for each output. A state_dict has the same entries as that of a masked
    layer: the dense weight and, except for targets, the boolean ``weight_mask``. :meth:`convert`
    makes one out of a dense layer, in place.
    """

    dense_class: ClassVar[Any]
    """The class of torch that computes the same on a dense weight."""
    weight: nn.Parameter
    bias: Any
    structure: Structure
    snapshot: Snapshot | None
    """What a hard target computes with if the mask has moved since its last copy; else None."""
    is_target: bool
    listener: Listener | None
    check_mask: Callable[[th.Tensor], None] | None
    """Rejects a saved mask that does not fit the layer's sparsity."""

    @classmethod
    def takes(cls, module: nn.Module) -> bool:
        """Whether :meth:`convert` can make this module sparse."""
        return type(module) is cls.dense_class

    @property
    def dense_shape(self) -> tuple[int, ...]:
        """Shape of the dense weight, with as many elements as ``structure.shape``."""
        return self.structure.shape

    @classmethod
    def convert(
        cls: type[Layer], module: nn.Module, structure: Structure, is_target: bool
    ) -> Layer:
        """Make ``module`` sparse, in place; its Parameter stays the same object.

        :param module: a layer that :meth:`takes` is true of
        """
        assert cls.takes(module)
        layer = become(module, cls)
        dense = layer.weight.detach()
        layer.structure = structure
        layer.snapshot = None
        layer.is_target = is_target
        layer.listener = None
        layer.check_mask = None
        layer.weight.grad = None
        layer.take_saved(dense)
        return layer

    def to_dense(self) -> None:
        """Become :attr:`dense_class` again, in place; the Parameter stays the same object."""
        dense = self.dense()
        become(self, self.dense_class)
        for name in ("structure", "snapshot", "is_target", "listener", "check_mask"):
            del vars(self)[name]
        replace_data(self.weight, dense)

    def __getstate__(self) -> dict[str, Any]:
        # A copy gets a listener with its own hooks.
        return {**self.__dict__, "listener": None}

    def _apply(self, fn: Any, recurse: bool = True) -> Any:
        check_conversion(fn)
        return super()._apply(fn, recurse)  # type: ignore[no-untyped-call]

    def apply(self: Layer, fn: Callable[[nn.Module], Any]) -> Layer:
        """Apply ``fn`` as torch does; it sees the dense weight and may write it.

        Values that it writes to inactive connections are dropped.
        """
        dense, grad = self.dense(), self.weight.grad
        replace_data(self.weight, dense)
        try:
            fn(self)
            dense = self.weight.detach().clone()
        finally:
            self.take_saved(dense)
            self.weight.grad = grad
        return self

    def reset_parameters(self) -> None:
        """Draw weights and biases as the dense layer does; inactive connections stay absent."""
        if self.weight.dim() > 1:  # within :meth:`apply`, or while torch builds the layer
            self.dense_class.reset_parameters(self)
        else:
            self.apply(self.dense_class.reset_parameters)

    def live(self) -> tuple[Structure, th.Tensor]:
        """Return the connections to compute with now, and their values."""
        if self.snapshot is not None:
            if th.equal(self.weight.detach(), self.snapshot.placed):
                return self.snapshot.structure, self.snapshot.values
            self.snapshot = None  # the Parameter was written: copied or averaged
        return self.structure, self.weight

    def held(self) -> tuple[Structure, th.Tensor]:
        """As :meth:`live`, without a graph, for threads that act while another moves connections.

        The two results fit each other and stay in memory.
        """
        for _ in range(TRIES):
            structure, weight = self.live()
            values = weight.data
            if len(values) == structure.nnz:
                break
            time.sleep(0)
        return structure, values

    def dense(self) -> th.Tensor:
        """Return the weights, 0 where inactive, shape :attr:`dense_shape`."""
        structure, values = self.live()
        return dense_weight(structure, values.detach(), self.dense_shape)

    def restructure(self, structure: Structure, values: th.Tensor) -> None:
        """Replace connections and values, and drop the gradient.

        :param values: shape ``(structure.nnz,)``
        """
        self.structure = structure
        self.snapshot = None
        replace_data(self.weight, values)

    def await_copy(self, structure: Structure) -> None:
        """Keep computing with the present weights until they are written (for hard targets).

        :param structure: the new connections of the online layer
        """
        own, values = self.live()
        values = values.detach().clone()
        self.take(structure, self.dense())
        self.snapshot = Snapshot(own, values, self.weight.detach().clone())

    def take(self, structure: Structure, dense: th.Tensor) -> None:
        """Replace the connections and take their weights from a dense array.

        :param dense: shape :attr:`dense_shape`; values outside the structure are dropped
        """
        self.restructure(structure, dense.detach().reshape(-1)[th.from_numpy(structure.flat)])

    def take_saved(self, dense: th.Tensor) -> None:
        """Take weights from a dense array; a target keeps those outside its mask as a snapshot.

        :param dense: shape :attr:`dense_shape`
        """
        own = Structure.of_mask(dense.numpy() != 0, self.structure.shape)
        self.take(self.structure, dense)
        if self.is_target and (own.places_in(self.structure) < 0).any():
            values = dense.reshape(-1)[th.from_numpy(own.flat)]
            self.snapshot = Snapshot(own, values, self.weight.detach().clone())

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        destination[prefix + "weight"] = self.dense()
        if not self.is_target:
            mask = th.from_numpy(self.structure.mask()).view(self.dense_shape)
            destination[prefix + MASK_KEY] = mask

    def _load_from_state_dict(
        self, state_dict: Any, prefix: str, local_metadata: Any, strict: bool,
        missing_keys: Any, unexpected_keys: Any, error_msgs: Any,
    ) -> None:  # fmt: skip
        weight = state_dict.get(prefix + "weight")
        mask = state_dict.pop(prefix + MASK_KEY, None)
        if self.is_target:
            mask = None  # it follows the online layer
        elif mask is None and strict:
            missing_keys.append(prefix + MASK_KEY)
        for name, tensor in (("weight", weight), (MASK_KEY, mask)):
            if tensor is not None and tuple(tensor.shape) != self.dense_shape:
                error_msgs.append(
                    f"size mismatch for {prefix}{name}: copying a param with shape "
                    f"{tuple(tensor.shape)} from checkpoint, the shape in current model is "
                    f"{self.dense_shape}."
                )
                return
        if mask is not None:
            if self.check_mask is not None:
                self.check_mask(mask)
            structure = Structure.of_mask(mask.cpu().numpy(), self.structure.shape)
            if not structure.equals(self.structure):
                self.take(structure, self.dense())
        if weight is not None:
            self.take_saved(weight.to(device="cpu", dtype=th.float32))
            state_dict[prefix + "weight"] = self.weight.detach().clone()
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )


def dense_weight(structure: Structure, values: th.Tensor, shape: tuple[int, ...]) -> th.Tensor:
    """Return a dense weight, differentiable by the values of its active connections.

    :param values: shape ``(structure.nnz,)``
    :param shape: of the dense weight, with as many elements as ``structure.shape``
    """
    rows, columns = structure.shape
    flat = th.from_numpy(structure.flat)
    if th.onnx.is_in_onnx_export():
        # The tracer knows the dense weights of the state_dict, not these values.
        values = values.data
    return values.new_zeros(rows * columns).index_put((flat,), values).view(shape)


def check_conversion(fn: Callable[[th.Tensor], th.Tensor]) -> None:
    """Reject a conversion of a sparse layer to anything but float32 on the CPU.

    :param fn: the conversion that torch is about to apply to every parameter and buffer
    :raises UnsupportedError: if it changes type or device
    """
    probe = fn(th.empty(0, dtype=th.float32, device="cpu"))
    if probe.device.type != "cpu" or probe.dtype != th.float32:
        raise UnsupportedError(
            "layers in sparse storage stay float32 on the CPU, and cannot become "
            f"{probe.dtype} on {probe.device}; make the policy with compute='masked'"
        )
