"""Translates torch modules to operations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeGuard, TypeVar

import numpy as np
import torch as th
from torch import nn

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.sequential import ChainedSequential
from sb3_sparse.export.activations import nodes_of
from sb3_sparse.export.builder import GraphBuilder
from sb3_sparse.export.forward import trace_forward
from sb3_sparse.export.nodes import (
    Affine,
    Concat,
    Conv,
    Flatten,
    Floats,
    Linear,
    MaxPool,
    Normalize,
    Standardize,
)
from sb3_sparse.policies.compiled import unwrapped

Module = TypeVar("Module", bound=nn.Module)

FAR = 10.0
"""If the mean is more standard deviations from 0, observations are centred before all else."""
RENORM = "BatchRenorm"
"""sb3-contrib's normalisation (CrossQ), known by name since it need not be installed."""
DROPOUTS = (nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.AlphaDropout, nn.FeatureAlphaDropout)
OWN_FORWARDS = (SparseLinear.forward, SparseConv2d.forward, ChainedSequential.forward)
"""Methods that compute the same as torch's."""


class Tracer(GraphBuilder):
    """Collects the operations of modules."""

    def walk(self, module: nn.Module, value: int | Mapping[str, int]) -> int:
        """Apply a module to a value, or to a dict of values, and return the result.

        :raises UnsupportedError: if the module does what cannot be exported
        """
        module = unwrapped(module)
        if not isinstance(value, int):
            return trace_forward(self, self.walk, module, value)
        if getattr(module, "inplace", False):
            self.changed.update(self.sources(value))
        elementwise = nodes_of(module)
        if elementwise is not None:
            for make in elementwise:
                value = self.add(make(value, self.shape_of(value)))
            return value
        if _does(module, nn.Linear):
            return self._linear(module, value)
        if _does(module, nn.Conv2d):
            return self._conv(module, value)
        if _does(module, nn.MaxPool2d):
            return self._max_pool(module, value)
        if _does(module, nn.Flatten):
            return self._flatten(module, value)
        if _does(module, *DROPOUTS):
            return value
        if _does(module, nn.BatchNorm1d, nn.BatchNorm2d):
            return self._norm(module, "running_mean", "running_var", "weight", value)
        if _does(module, nn.LayerNorm):
            return self._layer_norm(module, value)
        if any(cls.__name__ == RENORM for cls in type(module).__mro__):
            return self._norm(module, "ra_mean", "ra_var", "scale", value)
        if _does(module, nn.Sequential):
            for child in module.children():
                value = self.walk(child, value)
            return value
        if type(module).__module__.startswith("torch.nn.modules."):
            raise self.unsupported(module)
        return trace_forward(self, self.walk, module, value)

    def _flatten(self, module: nn.Flatten, value: int) -> int:
        shape = self.shape_of(value)
        axes = (module.start_dim, module.end_dim)
        if axes not in ((1, -1), (1, len(shape))):
            raise self.unsupported(module, f"it is of the axes {axes}", "the axes 1 to -1")
        if len(shape) == 1:
            return value
        return self.add(Flatten((value,), (int(np.prod(shape)),)))

    def _linear(self, module: nn.Linear, value: int) -> int:
        if len(self.shape_of(value)) != 1:
            raise self.unsupported(
                module, f"it takes a value of shape {self.shape_of(value)}", "vectors: flatten it"
            )
        weight, bias = _arrays(module)
        if weight.shape[1:] != self.shape_of(value):
            raise self.unsupported(
                module,
                f"of {weight.shape[1]} features it gets {self.shape_of(value)[0]}, so the policy "
                "does more than its modules show",
            )
        return self.add(Linear((value,), (len(weight),), weight, bias))

    def _conv(self, module: nn.Conv2d, value: int) -> int:
        if (
            module.groups != 1
            or module.dilation != (1, 1)
            or module.padding_mode != "zeros"
            or isinstance(module.padding, str)
        ):
            raise self.unsupported(
                module,
                f"it is {module}",
                "convolutions without groups, dilation and named padding, with zeros around",
            )
        weight, bias = _arrays(module)
        stride, padding = _pair(module.stride), _pair(module.padding)
        size = _sizes(self.shape_of(value), weight.shape[2:], stride, padding)
        return self.add(Conv((value,), (len(weight), *size), weight, bias, stride, padding))

    def _max_pool(self, module: nn.MaxPool2d, value: int) -> int:
        if _pair(module.dilation) != (1, 1) or module.return_indices or module.ceil_mode:
            raise self.unsupported(
                module, f"it is {module}", "those without dilation, indices and ceil_mode"
            )
        kernel, stride = _pair(module.kernel_size), _pair(module.stride)
        padding = _pair(module.padding)
        shape = self.shape_of(value)
        size = _sizes(shape, kernel, stride, padding)
        return self.add(MaxPool((value,), (shape[0], *size), kernel, stride, padding))

    def _layer_norm(self, module: nn.LayerNorm, value: int) -> int:
        shape = self.shape_of(value)
        if tuple(module.normalized_shape) != shape or len(shape) > 1:
            raise self.unsupported(
                module, f"it takes a value of shape {shape}", "vectors, normalised as a whole"
            )
        value = self.add(Standardize((value,), shape, float(module.eps)))
        if not module.elementwise_affine:
            return value
        scale = _array(module.weight)
        shift = np.zeros_like(scale) if module.bias is None else _array(module.bias)
        return self.add(Affine((value,), shape, scale, shift))

    def _norm(self, module: Any, mean: str, var: str, weight: str, value: int) -> int:
        """Translate batch normalisation, which uses its running statistics in evaluation."""
        if getattr(module, mean) is None:
            raise self.unsupported(module, "it keeps no statistics", "those that keep them")
        centre = _array(getattr(module, mean)).astype(np.float64)
        deviation = np.sqrt(_array(getattr(module, var)).astype(np.float64) + module.eps)
        shape = self.shape_of(value)
        if (
            self._has_observation(value)
            and len(shape) == 1
            and (np.abs(centre) > FAR * deviation).any()
        ):
            # Folded into the next layer, such terms would cancel and leave few digits.
            value = self.add(Normalize((value,), shape, centre, 1.0 / deviation, np.inf))
            centre, deviation = np.zeros_like(centre), np.ones_like(deviation)
        scale = np.ones_like(deviation)
        shift = np.zeros_like(deviation)
        if module.affine:
            scale, shift = _array(getattr(module, weight)), _array(module.bias)
        scale = scale / deviation
        shift = shift - centre * scale
        return self.add(Affine((value,), shape, scale.astype(np.float32), shift.astype(np.float32)))

    def _has_observation(self, value: int) -> bool:
        """Tell whether a value is the observation, perhaps beside others, as critics read it."""
        node = self.nodes[value - 1] if value else None
        parts = node.inputs if isinstance(node, Concat) else (value,)
        return any(self.sources(part)[-1] == 0 for part in parts)


def _does(module: nn.Module, *kinds: type[Module]) -> TypeGuard[Module]:
    """Tell whether a module is of one of these kinds and has not overridden its ``forward``."""
    forward = type(module).forward
    return isinstance(module, kinds) and forward in (
        *(kind.forward for kind in kinds),
        *OWN_FORWARDS,
    )


def _arrays(module: nn.Linear | nn.Conv2d) -> tuple[Floats, Floats]:
    """Return dense weight and bias, whatever the storage."""
    weight = _array(module.state_dict().get("weight", module.weight))  # else parametrized
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
