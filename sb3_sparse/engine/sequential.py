"""A ``Sequential`` that runs its sparse layers as chains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch as th
from torch import nn

from sb3_sparse.engine.activations import ACTIVATIONS, ADJUSTABLE, tells_its_slope
from sb3_sparse.engine.chains import Chain, watched
from sb3_sparse.engine.image_modules import ImageAttributes, has_convolution, steps_of
from sb3_sparse.engine.images import ImageChain
from sb3_sparse.engine.inference import by_modules
from sb3_sparse.engine.internals import MODULE_HOOKS, any_global_hook, become
from sb3_sparse.engine.kept import KeptInference
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.paths import modules_of

ELEMENTWISE = (*ACTIVATIONS, nn.Identity)
"""Activations that work on tiles unchanged."""


class Split(NamedTuple):
    """The chains of a ``Sequential``, for as long as its modules stay the same.

    :param called: the modules that it was made for
    :param steps: chains and other modules, and whether a chain's input and output are tiles
    :param adjustable: activations within the chains whose parameters the user may change
    :param attributes: of the modules on images
    """

    called: tuple[nn.Module, ...]
    steps: list[tuple[Any, bool, bool]]
    adjustable: Sequence[nn.Module]
    attributes: ImageAttributes

    @classmethod
    def of(cls, modules: Sequence[nn.Module], called: tuple[nn.Module, ...]) -> Split:
        """Split modules that are called in turn, and may call others."""
        attributes = ImageAttributes(called if any(map(has_convolution, modules)) else ())
        steps = _steps(modules)
        fused = (after for step, *_ in steps for after in getattr(step, "activations", ()))
        adjustable = [after for after in fused if isinstance(after, ADJUSTABLE)]
        return cls(called, steps, adjustable, attributes)

    def fits(self, called: tuple[nn.Module, ...]) -> bool:
        """Whether the modules and their settings are those that it was made for."""
        return (
            called == self.called
            and self.attributes.unchanged()
            and all(map(tells_its_slope, self.adjustable))
        )


class ChainedSequential(nn.Sequential):
    """A ``Sequential`` that runs its sparse layers, also those of residual blocks, as chains.

    With hooks on its modules, and under tracing, it calls the modules one by one, as torch does.
    """

    _split: Split | None = None
    """Read once and written last: other threads may act meanwhile."""
    _kept: KeptInference

    def __init__(self, *modules: Any) -> None:  # torch calls it for a slice
        super().__init__(*modules)
        self.forget()

    def forget(self) -> None:
        """Look for chains anew at the next call."""
        vars(self).update(_split=None, _kept=KeptInference())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_split": None}

    def forward(self, input: th.Tensor) -> th.Tensor:
        """Apply the modules in turn, as ``Sequential`` does."""
        if not th.is_grad_enabled() and not by_modules(input):
            results = self._inferred(input)
            if results is not None:
                return results[0]
        modules = called = tuple(self._modules.values())
        if any(module._modules for module in modules):  # residual blocks
            called = tuple(modules_of([modules]))
        hooked = any(getattr(module, hooks) for module in called for hooks in MODULE_HOOKS)
        hooked = hooked or any("forward" in vars(module) for module in called)
        if hooked or watched(input) or any_global_hook():
            y: th.Tensor = super().forward(input)  # type: ignore[no-untyped-call]
            return y
        split = self._split
        if split is None or not split.fits(called):
            split = self._split = Split.of(modules, called)
        x, batch, lead = input, 0, input.shape[:-1]
        for step, tiled_in, tiled_out in split.steps:
            if not isinstance(step, Chain):
                x = step(x)
                continue
            if not tiled_in:
                x, batch, lead = step.flattened(x)
            x = step.run(x, batch, tiled_in, tiled_out)
            if not tiled_out:
                x = x.view(*lead, step.rows)
        return x

    def _inferred(self, x: th.Tensor) -> list[th.Tensor] | None:
        inference = self._kept.get(lambda: ([[self]], [self]))
        return None if inference is None else inference(x)


def _steps(modules: Sequence[Any]) -> list[tuple[Any, bool, bool]]:
    """Group modules into chains and others; tell whether a chain's input and output are tiles."""
    groups: list[Any] = []
    position = 0
    while position < len(modules):
        module = modules[position]
        if has_convolution(module):
            steps, layers, count = steps_of(modules[position:])
            if steps:
                groups.append(ImageChain(steps, layers))
                position += count
                continue
        position += 1
        last = groups[-1] if groups else None
        if isinstance(module, SparseLinear):
            if isinstance(last, list):
                last.append((module, None))
            else:
                groups.append([(module, None)])
        elif isinstance(last, list) and last[-1][1] is None and tells_its_slope(module):
            last[-1] = (last[-1][0], module)
        else:
            groups.append(module)
    found: list[tuple[Any, bool, bool]] = []
    tiled = False
    for i, group in enumerate(groups):
        if not isinstance(group, list):
            tiled = tiled and type(group) in ELEMENTWISE
            found.append((group, False, False))
            continue
        behind = next((g for g in groups[i + 1 :] if type(g) not in ELEMENTWISE), None)
        chain = Chain([module for module, _ in group], [after for _, after in group])
        found.append((chain, tiled, isinstance(behind, list)))
        tiled = isinstance(behind, list)
    return found


def chain_up(root: nn.Module) -> None:
    """Make every ``Sequential`` below ``root`` run its sparse layers as chains."""
    for module in root.modules():
        if type(module) not in (nn.Sequential, ChainedSequential):
            continue
        if any(
            isinstance(child, SparseLinear) or has_convolution(child) for child in module.children()
        ):
            become(module, ChainedSequential).forget()  # more layers may be sparse now
        elif type(module) is ChainedSequential:
            unchain(module)


def unchain(module: ChainedSequential) -> None:
    """Turn it into a plain ``Sequential`` again, in place."""
    for name in ("_split", "_kept"):
        vars(module).pop(name, None)
    become(module, nn.Sequential)
