"""Networks that act: up to 16 inputs through all layers in one call of the kernels.

In a rollout a layer takes a few microseconds of arithmetic and more than that of torch's overhead.
Here one call takes an observation through every layer, activation and head, without a graph. It
reads masked layers through their masks, so inactive weights always count as 0.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn
from torch.compiler import is_compiling

from sb3_sparse.engine.activations import ADJUSTABLE, number_of
from sb3_sparse.engine.buffer import FloatBuffer
from sb3_sparse.engine.chains import watched
from sb3_sparse.engine.changes import patched
from sb3_sparse.engine.internals import any_global_hook, watching
from sb3_sparse.engine.layer import TRIES
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.native.library import bits_of, library, readable, why_missing
from sb3_sparse.engine.norms import is_ready, settings_of_norm
from sb3_sparse.engine.paths import Paths, modules_of
from sb3_sparse.engine.steps import Step, steps_of, tensors_of
from sb3_sparse.engine.structure import Structure

MOST_INPUTS = 16
"""``LANES`` of ``kernels.h``."""
DOUBLES: dict[Any, bool] = {
    **{th.float32: False, th.float64: True},
    **{np.dtype(np.float32): False, np.dtype(np.float64): True},
}
"""Types of observations that the kernels read, and whether they are float64."""


def by_modules(x: th.Tensor) -> bool:
    """Whether networks must act module by module: to be observed or compiled."""
    return is_compiling() or watched(x)


class Binding(NamedTuple):
    """Addresses of the tensors for the kernels; holds the tensors, so that they stay allocated."""

    tensors: list[int]
    sizes: list[th.Size]
    structures: list[Structure]
    settings: list[tuple[Any, ...]]
    arguments: Any
    held: list[th.Tensor]


class Inference:
    """Computes networks that share their input at once.

    Create it with :meth:`of`, and call it with inputs of shape ``(n, features)``.
    """

    def __init__(self, steps: list[Step], ends: list[int], modules: Iterable[nn.Module]) -> None:
        self._steps = steps
        self._ends = ends
        self._columns = steps[0].layer.in_features
        self._widths = [steps[end].layer.out_features for end in ends]
        self._places = [sum(self._widths[:i]) for i in range(len(ends))]
        self._total = sum(self._widths)
        self._layers = [step.layer for step in steps]
        self._sparse = [layer for layer in self._layers if isinstance(layer, SparseLinear)]
        activations = [step.activation for step in steps]
        self._adjustable = [m for m in activations if isinstance(m, ADJUSTABLE)]
        self._norms = [step.norm for step in steps if step.norm is not None]
        self._targets = [layer for layer in self._sparse if layer.is_target]
        hooks = ((vars(m)["_forward_hooks"], vars(m)["_forward_pre_hooks"]) for m in modules)
        self._hooks = list(chain.from_iterable(hooks))
        self._tensors: list[th.Tensor] = [
            tensor for step in steps for tensor in tensors_of(step) if tensor is not None
        ]
        numbers = {id(tensor): number for number, tensor in enumerate(self._tensors)}
        self._values = [numbers[id(layer.weight)] for layer in self._sparse]
        self._binding: Binding | None = None
        self._call = library().sb3_sparse_act

    @classmethod
    def of(cls, paths: Paths, hooked: Iterable[nn.Module] = ()) -> Inference | None:
        """Create it for some networks; None if they have parts that the kernels do not compute.

        :param paths: modules of each network; layers that two networks share are computed once
        :param hooked: modules around the networks, whose hooks expect to see the call
        """
        modules = [*hooked, *modules_of(paths)]
        if any(map(patched, modules)) or why_missing() is not None:
            return None
        found = steps_of(paths)
        return None if found is None else cls(*found, modules)

    @property
    def watched(self) -> bool:
        """Whether hooks or autocast require that the modules are called."""
        return any(self._hooks) or th.is_autocast_enabled("cpu") or bool(any_global_hook())

    def __call__(self, x: th.Tensor) -> list[th.Tensor] | None:
        """Compute each network's result, shape ``(n, its outputs)``, without a graph.

        None where the modules must be called one by one: for more than 16 inputs; for inputs that
        are not float32 of the right width on the CPU; under hooks, tracing or autocast; and for
        results that are not finite, which callers report in their own way.

        :param x: shape ``(n, features)``
        """
        if by_modules(x) or not 0 < x.shape[0] <= MOST_INPUTS:
            return None
        if x.dim() != 2 or x.dtype is not th.float32:
            return self._leave()
        return self.of_observations(x)

    def _leave(self) -> list[th.Tensor] | None:
        """Prepare the modules to compute the same: set inactive weights to 0."""
        for layer in self._layers:
            for masked in MaskedStorage.below(layer):
                masked.remask()
        return None

    def of_observations(self, x: th.Tensor) -> list[th.Tensor] | None:
        """As a call, for 1 to 16 observations that may be float64 and of several dimensions.

        :param x: shape ``(n, *shape of an observation)``; :func:`by_modules` must be False
        """
        n, doubles = len(x), DOUBLES.get(x.dtype)
        if doubles is None or not x.is_cpu or x.numel() != n * self._columns:
            return self._leave()
        if not x.is_contiguous() or x.is_neg():
            x = x.contiguous().resolve_neg()
        buffer = self._compute(n, doubles, x.data_ptr())
        return self._leave() if buffer is None else [buffer.tensor(*at) for at in self._split(n)]

    def of_array(self, x: NDArray[Any]) -> list[NDArray[np.float32]] | None:
        """As a call, for an array of observations of any type and number; return arrays."""
        n, doubles = x.shape[0], DOUBLES.get(x.dtype)
        if doubles is None or not 0 < n <= MOST_INPUTS or x.size != n * self._columns or watching():
            return None
        buffer = self._compute(n, doubles, x.tobytes())
        return None if buffer is None else [buffer.array(*at) for at in self._split(n)]

    def _compute(self, n: int, doubles: bool, x: int | bytes) -> FloatBuffer | None:
        """Compute the networks' results, one after the other.

        :param n: number of inputs
        :param doubles: whether the inputs are float64 rather than float32
        :param x: address of the inputs, or their bytes
        """
        on_cpu = self._tensors[0].is_cpu
        binding = self._bound() if on_cpu and not self.watched else None
        if binding is None:
            return None
        buffer = FloatBuffer(n * self._total)
        steps = len(self._steps)
        failed = self._call(binding.arguments, steps, n, doubles, x, buffer.memory)
        return None if failed else buffer

    def _split(self, n: int) -> Iterator[tuple[tuple[int, int], int]]:
        """Return the shape of each network's results, and where they begin."""
        return (
            ((n, width), n * place) for width, place in zip(self._widths, self._places, strict=True)
        )

    def _bound(self) -> Binding | None:
        """Return the present addresses of the tensors; None if the kernels cannot read one."""
        for target in self._targets:
            if target.snapshot is not None:
                return None  # it waits for the next copy
        tensors = [tensor.data_ptr() for tensor in self._tensors]
        sizes = list(map(th.Tensor.size, self._tensors))
        structures = [layer.structure for layer in self._sparse]
        settings = self._settings()
        binding = self._binding
        if (
            binding is not None
            and tensors == binding.tensors
            and sizes == binding.sizes
            and structures == binding.structures
            and settings == binding.settings
            and all(map(th.Tensor.is_contiguous, self._tensors))
        ):
            return binding
        self._binding = binding = self._bind()
        return binding

    def _settings(self) -> list[tuple[Any, ...]]:
        return [*map(number_of, self._adjustable), *map(settings_of_norm, self._norms)]

    def _bind(self) -> Binding | None:
        """Hold the present tensors for as long as the kernels may read them.

        While another thread moves connections, a structure may briefly not fit its values.
        """
        for _ in range(TRIES):
            structures = [layer.structure for layer in self._sparse]
            # Not detach(), which lets other threads run while it looks at the tensor.
            held = [tensor.data for tensor in self._tensors]
            values = [held[number] for number in self._values]
            if [len(v) for v in values] == [structure.nnz for structure in structures]:
                break
            time.sleep(0)
        arguments = self._arguments(iter(structures), iter(held))
        if arguments is None:
            return None
        return Binding(
            [tensor.data_ptr() for tensor in held],
            [tensor.size() for tensor in held],
            structures,
            self._settings(),
            arguments,
            held,
        )

    def _arguments(self, structures: Iterator[Structure], held: Iterator[th.Tensor]) -> Any:
        """Fill an array of ``step_t``; None if the kernels cannot read a tensor.

        :param structures: connections of the sparse layers
        :param held: the layers' tensors, in order
        """
        if not all(map(is_ready, self._norms)):
            return None
        fields: list[int] = []
        for number, step in enumerate(self._steps):
            layer = step.layer
            shape = layer.out_features, layer.in_features
            sizes: list[tuple[int, ...]] = [shape, shape[:1], shape, *[shape[1:]] * 4]
            start = column = 0
            if isinstance(layer, SparseLinear):
                structure = next(structures)
                start, column = structure.addresses[:2]
                sizes[0] = (structure.nnz,)
                if structure.shape != shape:
                    return None
            places = []
            for tensor, size in zip(tensors_of(step), sizes, strict=True):
                place = 0
                if tensor is not None:
                    now = next(held)
                    if now.shape != size or not readable(now):
                        return None
                    place = now.data_ptr()
                places.append(place)
            weight, bias, mask, *of_norm = places
            kind, a, b = number_of(step.activation)
            out = -1
            if number in self._ends:
                out = self._places[self._ends.index(number)]
            fields += (*shape, start, column, weight, mask, bias)
            fields += (kind, bits_of(a), bits_of(b), step.source, out)
            epsilon = -1.0 if step.norm is None else settings_of_norm(step.norm)[0]
            fields += (bits_of(epsilon), *of_norm)
            fields.append(-2 if step.shortcut is None else step.shortcut)
        return (ctypes.c_int64 * len(fields))(*fields)
