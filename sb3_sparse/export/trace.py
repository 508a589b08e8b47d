"""From torch modules to operations."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from torch import fx, nn

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.graph import (
    Activation,
    Add,
    Affine,
    Clip,
    Conv,
    Flatten,
    Floats,
    Linear,
    MaxPool,
    Node,
    Normalize,
)

FAR = 10.0
"""Standard deviations from 0 at which observations are centred before anything else."""
RENORM = "BatchRenorm"
"""sb3-contrib's normalisation (CrossQ), known by name: it need not be installed here."""
ACTIVATIONS: dict[type[nn.Module], Callable[[Any], tuple[str, float]]] = {
    nn.ReLU: lambda module: ("relu", 0.0),
    nn.LeakyReLU: lambda module: ("leaky_relu", module.negative_slope),
    nn.ELU: lambda module: ("elu", module.alpha),
    nn.Tanh: lambda module: ("tanh", 0.0),
    nn.Sigmoid: lambda module: ("sigmoid", 0.0),
    nn.SiLU: lambda module: ("silu", 0.0),
}
FUNCTIONS = {
    th.relu: "relu",
    nn.functional.relu: "relu",
    th.tanh: "tanh",
    th.sigmoid: "sigmoid",
    nn.functional.silu: "silu",
    "relu": "relu",
    "tanh": "tanh",
    "sigmoid": "sigmoid",
}
"""What a ``forward`` may call on its own, as a function or a method."""
ADDITIONS = (operator.add, operator.iadd, th.add, "add", "add_")
IN_PLACE = (operator.iadd, "add_")
ALLOWED = (
    "Linear, Conv2d, MaxPool2d, Flatten, BatchNorm, Hardtanh, Dropout, Identity, "
    + ", ".join(kind.__name__ for kind in ACTIVATIONS)
    + ", and modules whose forward does nothing but call, add and flatten"
)


@dataclass
class Tracer:
    """Collects operations while it walks through modules.

    :param observation_shape: of one observation
    """

    observation_shape: tuple[int, ...]
    nodes: list[Node] = field(default_factory=list)
    changed: set[int] = field(default_factory=set)
    """Values that torch changes in place."""

    def shape_of(self, value: int) -> tuple[int, ...]:
        """Shape of a value so far."""
        return self.nodes[value - 1].shape if value else self.observation_shape

    def add(self, node: Node) -> int:
        """Append an operation; the number of its result."""
        self.nodes.append(node)
        return len(self.nodes)

    def walk(self, module: nn.Module, value: int) -> int:
        """The result of a module applied to a value.

        :raises UnsupportedError: if it does what cannot be exported
        """
        shape = self.shape_of(value)
        if getattr(module, "inplace", False):
            self.changed.update(self._sources(value))
        if type(module) in ACTIVATIONS:
            kind, slope = ACTIVATIONS[type(module)](module)
            return self.add(Activation((value,), shape, kind, slope))
        if isinstance(module, nn.Linear):
            return self._linear(module, value)
        if isinstance(module, nn.Conv2d):
            return self._conv(module, value)
        if isinstance(module, nn.MaxPool2d):
            return self._max_pool(module, value)
        if isinstance(module, nn.Flatten):
            return self.flatten(value, module.start_dim, module.end_dim)
        if isinstance(module, nn.Hardtanh):
            units = np.ones(shape[0], np.float32)
            low, high = units * module.min_val, units * module.max_val
            return self.add(Clip((value,), shape, low, high))
        if isinstance(module, (nn.Identity, nn.Dropout)):
            return value
        if isinstance(module, (nn.BatchNorm1d, nn.BatchNorm2d)):
            return self._norm(module, "running_mean", "running_var", "weight", value)
        if any(cls.__name__ == RENORM for cls in type(module).__mro__):
            return self._norm(module, "ra_mean", "ra_var", "scale", value)
        if isinstance(module, nn.Sequential):
            for child in module:
                value = self.walk(child, value)
            return value
        return self._forward(module, value)

    def flatten(self, value: int, first: int = 1, last: int = -1) -> int:
        """All units of a value in one row."""
        if first != 1 or last != -1:
            raise UnsupportedError(
                f"a Flatten from axis {first} to {last} cannot be exported; allowed is 1 to -1"
            )
        shape = self.shape_of(value)
        if len(shape) == 1:
            return value
        return self.add(Flatten((value,), (int(np.prod(shape)),)))

    def finish(self) -> tuple[Node, ...]:
        """All operations.

        :raises UnsupportedError: if a value that was changed in place is used otherwise, too
        """
        for value in self.changed:
            if sum(value in node.inputs for node in self.nodes) > 1:
                raise UnsupportedError(
                    "a network that changes a value in place (inplace=True, +=) and uses it "
                    "elsewhere too cannot be exported; build it with inplace=False"
                )
        return tuple(self.nodes)

    def _sources(self, value: int) -> list[int]:
        """A value, and what it is another view of."""
        found = [value]
        while found[-1] and isinstance(node := self.nodes[found[-1] - 1], Flatten):
            found.append(node.inputs[0])
        return found

    def _linear(self, module: nn.Linear, value: int) -> int:
        if len(self.shape_of(value)) != 1:
            raise UnsupportedError(
                f"{module} of a value of shape {self.shape_of(value)} cannot be exported; allowed "
                "are vectors: flatten it before"
            )
        weight, bias = _arrays(module)
        if weight.shape[1:] != self.shape_of(value):
            raise UnsupportedError(
                f"{module} gets {self.shape_of(value)[0]} features here; the policy does more than "
                "its modules show and cannot be exported"
            )
        return self.add(Linear((value,), (len(weight),), weight, bias))

    def _conv(self, module: nn.Conv2d, value: int) -> int:
        if (
            module.groups != 1
            or module.dilation != (1, 1)
            or module.padding_mode != "zeros"
            or isinstance(module.padding, str)
        ):
            raise UnsupportedError(
                f"{module} cannot be exported; allowed are convolutions without groups, dilation "
                "and named padding, with zeros around"
            )
        weight, bias = _arrays(module)
        stride, padding = _pair(module.stride), _pair(module.padding)
        size = _sizes(self.shape_of(value), weight.shape[2:], stride, padding)
        return self.add(Conv((value,), (len(weight), *size), weight, bias, stride, padding))

    def _max_pool(self, module: nn.MaxPool2d, value: int) -> int:
        if _pair(module.dilation) != (1, 1) or module.return_indices:
            raise UnsupportedError(f"{module} cannot be exported; allowed is no dilation")
        kernel, stride = _pair(module.kernel_size), _pair(module.stride)
        padding = _pair(module.padding)
        if module.ceil_mode:
            raise UnsupportedError(f"{module} cannot be exported; allowed is ceil_mode=False")
        shape = self.shape_of(value)
        size = _sizes(shape, kernel, stride, padding)
        return self.add(MaxPool((value,), (shape[0], *size), kernel, stride, padding))

    def _norm(self, module: Any, mean: str, var: str, weight: str, value: int) -> int:
        """Batch normalisation as it is in evaluation: by its running statistics."""
        if getattr(module, mean) is None:
            raise UnsupportedError(f"{module} cannot be exported without running statistics")
        centre = _array(getattr(module, mean)).astype(np.float64)
        deviation = np.sqrt(_array(getattr(module, var)).astype(np.float64) + module.eps)
        shape = self.shape_of(value)
        if (
            self._sources(value)[-1] == 0
            and len(shape) == 1
            and (np.abs(centre) > FAR * deviation).any()
        ):
            # Folded into the layer behind, such terms would cancel out and leave few digits.
            value = self.add(Normalize((value,), shape, centre, 1.0 / deviation, np.inf))
            centre, deviation = np.zeros_like(centre), np.ones_like(deviation)
        scale = np.ones_like(deviation)
        shift = np.zeros_like(deviation)
        if module.affine:
            scale, shift = _array(getattr(module, weight)), _array(module.bias)
        scale = scale / deviation
        shift = shift - centre * scale
        return self.add(Affine((value,), shape, scale.astype(np.float32), shift.astype(np.float32)))

    def _forward(self, module: nn.Module, value: int) -> int:
        """Through a module's own ``forward``, if it is simple enough to be traced."""
        try:
            graph = _Leaves().trace(module)
        except Exception as error:  # whatever a forward does that cannot be traced
            raise UnsupportedError(
                f"{type(module).__name__} cannot be exported ({error}); allowed are {ALLOWED}"
            ) from error
        values: dict[fx.Node, int] = {}
        for node in graph.nodes:
            taken = [values.get(arg) for arg in node.args if isinstance(arg, fx.Node)]
            if node.op == "placeholder" and not values:
                values[node] = value
            elif node.op == "call_module" and len(taken) == 1 and taken[0] is not None:
                values[node] = self.walk(module.get_submodule(str(node.target)), taken[0])
            elif node.op == "output" and taken and taken[0] is not None:
                return taken[0]
            else:
                values[node] = self._call(module, node, taken)
        raise AssertionError("a graph has an output")

    def _call(self, module: nn.Module, node: fx.Node, taken: list[int | None]) -> int:
        target: Any = node.target
        if None not in taken and node.op in ("call_function", "call_method"):
            values = [value for value in taken if value is not None]
            shapes = [self.shape_of(value) for value in values]
            rest = [arg for arg in node.args if not isinstance(arg, fx.Node)]
            options = dict(node.kwargs)
            if options.pop("inplace", False) or target in IN_PLACE:
                self.changed.update(self._sources(values[0]))
            plain = not options and not rest
            if target in FUNCTIONS and len(values) == 1 and plain:
                return self.add(Activation((values[0],), shapes[0], FUNCTIONS[target]))
            if target in ADDITIONS and len(values) == 2 and shapes[0] == shapes[1] and plain:
                return self.add(Add(tuple(values), shapes[0]))
            if target in (th.flatten, "flatten") and len(values) == 1:
                axes: dict[str, Any] = dict(zip(("start_dim", "end_dim"), rest, strict=False))
                axes.update(node.kwargs)
                return self.flatten(values[0], axes.get("start_dim", 0), axes.get("end_dim", -1))
        raise UnsupportedError(
            f"{type(module).__name__} cannot be exported, because its forward does "
            f"{node.format_node()}; allowed are {ALLOWED}"
        )


class _Leaves(fx.Tracer):
    """Traces one module's ``forward`` and nothing below."""

    def is_leaf_module(self, m: nn.Module, module_qualified_name: str) -> bool:
        return True


def _arrays(module: nn.Linear | nn.Conv2d) -> tuple[Floats, Floats]:
    """Dense weight and bias, whatever the storage."""
    weight = _array(module.state_dict()["weight"])
    bias = module.bias
    return weight, np.zeros(len(weight), np.float32) if bias is None else _array(bias)


def _array(tensor: th.Tensor) -> Floats:
    array: Floats = tensor.detach().cpu().numpy().astype(np.float32)
    return array


def _pair(value: Any) -> tuple[int, int]:
    height, width = value if isinstance(value, tuple) else (value, value)
    return int(height), int(width)


def _sizes(
    shape: tuple[int, ...],
    kernel: tuple[int, ...],
    stride: tuple[int, int],
    padding: tuple[int, int],
) -> tuple[int, int]:
    height, width = (
        (size + 2 * p - k) // s + 1
        for size, k, s, p in zip(shape[1:], kernel, stride, padding, strict=True)
    )
    return height, width
