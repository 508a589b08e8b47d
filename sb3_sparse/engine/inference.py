"""Networks that act: up to 16 inputs through all layers in one call of the kernels.

In a rollout a layer is a few microseconds of arithmetic, and what surrounds it in torch is more.
Here one call takes an observation through every layer, activation and head, and keeps nothing for a
gradient. Masked layers are read through their masks, so what is inactive counts as 0 whoever has
written it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.nn.modules.module import _has_any_global_hook

from sb3_sparse.engine.activations import ADJUSTABLE, number_of
from sb3_sparse.engine.chains import watched
from sb3_sparse.engine.linear import CompactLinear
from sb3_sparse.engine.masked import FLOAT_MASK_KEY, MaskedLayer
from sb3_sparse.engine.native.library import bits_of, library, why_missing
from sb3_sparse.engine.paths import Paths, modules_of, parts_of
from sb3_sparse.engine.structure import Structure
from sb3_sparse.engine.watch import Watch

MOST_INPUTS = 16
MOST_STEPS = 64


class Step(NamedTuple):
    """One layer and the activation behind it.

    :param layer: the layer
    :param activation: what follows; None: nothing
    :param source: number of the step whose result is its input; -1: the observations
    """

    layer: nn.Linear
    activation: nn.Module | None
    source: int


class Binding(NamedTuple):
    """Where the tensors lie, ready for the kernels; holds them, so that nobody frees them."""

    tensors: list[int]
    structures: list[Structure]
    activations: list[tuple[int, float, float]]
    arguments: Any
    held: list[th.Tensor]


class Inference:
    """Networks that share their input, computed at once.

    Made by :meth:`of`. Call it with inputs of shape ``(n, features)``.
    """

    def __init__(self, steps: list[Step], ends: list[int], modules: Iterable[nn.Module]) -> None:
        self._steps = steps
        self._ends = ends
        self._columns = steps[0].layer.in_features
        self._widths = [steps[end].layer.out_features for end in ends]
        self._places = [sum(self._widths[:i]) for i in range(len(ends))]
        self._total = sum(self._widths)
        self._layers = [step.layer for step in steps]
        self._compact = [layer for layer in self._layers if isinstance(layer, CompactLinear)]
        self._activations = [step.activation for step in steps if step.activation is not None]
        self._adjustable = [m for m in self._activations if isinstance(m, ADJUSTABLE)]
        self._hooks = [
            hooks
            for module in modules
            for hooks in (module._forward_hooks, module._forward_pre_hooks)
        ]
        self._tensors: list[th.Tensor] = [
            tensor
            for layer in self._layers
            for tensor in (layer.weight, layer.bias, layer._buffers.get(FLOAT_MASK_KEY))
            if tensor is not None
        ]
        self._binding: Binding | None = None
        self._call = library().sb3_sparse_act

    @classmethod
    def of(cls, paths: Paths, hooked: Iterable[nn.Module] = ()) -> Inference | None:
        """What computes the networks at once; None if they have other parts than it knows.

        :param paths: where two begin with the same layers, these are computed once
        :param hooked: modules around them whose hooks would want to see the call
        """
        modules = [*hooked, *modules_of(paths)]
        patched = any("forward" in vars(module) for module in modules)
        if not paths or patched or why_missing() is not None:
            return None
        steps: list[Step] = []
        places: dict[tuple[int, ...], int] = {}
        ends = []
        for path in paths:
            parts = parts_of(path)
            if not parts:
                return None
            key: tuple[int, ...] = ()
            source = -1
            for layer, activation in parts:
                key += (id(layer), id(activation))
                if key not in places:
                    places[key] = len(steps)
                    steps.append(Step(layer, activation, source))
                source = places[key]
            ends.append(source)
        inputs = {step.layer.in_features for step in steps if step.source < 0}
        if len(steps) > MOST_STEPS or len(set(ends)) < len(ends) or len(inputs) > 1:
            return None
        return cls(steps, ends, modules)

    @property
    def on_cpu(self) -> bool:
        """Whether its tensors are where the kernels can read them."""
        return self._tensors[0].is_cpu

    def __call__(self, x: th.Tensor) -> list[th.Tensor] | None:
        """Each network's result, shape ``(n, its outputs)``, without a graph.

        None where the modules must be called one by one: for more inputs than 16, or others than
        float32 ones of the right width on the CPU, while somebody watches (hooks, tracing,
        autocast), and for results that are not finite, about which callers have their own to say.

        :param x: shape ``(n, features)``
        """
        if watched(x) or not 0 < x.shape[0] <= MOST_INPUTS:
            return None
        results = self._results(x)
        if results is None:
            # Let the modules compute what the kernels would: without what is inactive.
            for layer in self._layers:
                if (masked := MaskedLayer.of(layer)) is not None:
                    masked.remask()
        return results

    def _results(self, x: th.Tensor) -> list[th.Tensor] | None:
        n, *features = x.shape
        if (
            features != [self._columns]
            or x.dtype is not th.float32
            or not x.is_cpu
            or any(self._hooks)
            or th.is_autocast_enabled("cpu")
            or _has_any_global_hook()  # type: ignore[no-untyped-call]
        ):
            return None
        binding = self._bound()
        if binding is None:
            return None
        if not x.is_contiguous() or x.is_neg():
            x = x.contiguous().resolve_neg()
        y = th.empty(n * self._total, dtype=th.float32, device="cpu")
        if self._call(binding.arguments, len(self._steps), n, x.data_ptr(), y.data_ptr()):
            return None
        if len(self._widths) == 1:
            return [y.view(n, self._total)]
        return [
            y.as_strided((n, width), (width, 1), n * place)
            for width, place in zip(self._widths, self._places, strict=True)
        ]

    def _bound(self) -> Binding | None:
        """Where the tensors lie now; None if the kernels cannot read one."""
        tensors = [tensor.data_ptr() for tensor in self._tensors]
        structures = [layer.structure for layer in self._compact]
        activations = [number_of(module) for module in self._adjustable]
        binding = self._binding
        if (
            binding is not None
            and tensors == binding.tensors
            and structures == binding.structures
            and activations == binding.activations
            and all(map(th.Tensor.is_contiguous, self._tensors))
        ):
            return binding
        self._binding = None
        if not all(_readable(tensor) for tensor in self._tensors):
            return None
        if any(layer.snapshot is not None for layer in self._compact):
            return None  # a target that awaits its copy
        held = [tensor.detach() for tensor in self._tensors]
        self._binding = Binding(tensors, structures, activations, self._arguments(), held)
        return self._binding

    def _arguments(self) -> Any:
        """``step_t`` of every step."""
        fields: list[int] = []
        for number, (layer, activation, source) in enumerate(self._steps):
            start = column = mask_place = 0
            if isinstance(layer, CompactLinear):
                start, column = layer.structure.addresses[:2]
            elif (mask := layer._buffers.get(FLOAT_MASK_KEY)) is not None:
                mask_place = mask.data_ptr()
            kind, a, b = number_of(activation)
            out = -1
            if number in self._ends:
                out = self._places[self._ends.index(number)]
            bias = 0 if layer.bias is None else layer.bias.data_ptr()
            fields += (layer.out_features, layer.in_features, start, column)
            fields += (layer.weight.data_ptr(), mask_place, bias, kind, bits_of(a), bits_of(b))
            fields += (source, out)
        return (ctypes.c_int64 * len(fields))(*fields)


def _readable(tensor: th.Tensor) -> bool:
    return tensor.dtype == th.float32 and tensor.is_cpu and tensor.is_contiguous()


class KeptInference:
    """An inference that is made anew when modules have changed. Copies and pickles begin empty."""

    def __init__(self) -> None:
        self._watch: Watch | None = None
        self._inference: Inference | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> KeptInference:
        return KeptInference()

    def __reduce__(self) -> Any:
        return KeptInference, ()

    @property
    def found(self) -> bool:
        """Whether there was one at the last call, with its tensors on the CPU."""
        return self._inference is not None and self._inference.on_cpu

    def get(self, find: Callable[[], tuple[Paths, list[nn.Module]]]) -> Inference | None:
        """The inference; None where the modules must be called one by one.

        :param find: the paths, and the modules around them from the outermost, whose hooks are run
            anyhow, to those that the inference passes over
        """
        if self._watch is None or not self._watch.unchanged():
            paths, around = find()
            watch = Watch([*around, *modules_of(paths)])
            self._inference = Inference.of(paths, around[1:])
            self._watch = watch  # last: another thread may be looking
        return self._inference
