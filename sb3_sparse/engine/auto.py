"""Chooses the storage of each linear layer by what is quicker here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch as th
from torch import nn

from sb3_sparse.engine.layers import SparseLayer
from sb3_sparse.engine.native.library import why_missing
from sb3_sparse.engine.sequential import ELEMENTWISE
from sb3_sparse.engine.timing import Timing, timing_of

WORTH_MEASURING = 2**15
"""Connections of the dense layer below which overhead decides and masks stay."""
WORTH_CHANGING = 0.9
"""Share of the masked time that a run must stay below, so that noise decides nothing."""
LONGEST = 12
"""Layers of a run up to which all combinations are compared."""


@dataclass(frozen=True)
class LayerChoice:
    """What was chosen for one layer.

    :param name: of the layer
    :param compact: whether it stores and computes its active connections only
    :param masked_seconds: of a forward and backward pass with masks
    :param chosen_seconds: the same as chosen
    """

    name: str
    compact: bool
    masked_seconds: float
    chosen_seconds: float


@dataclass(frozen=True)
class Choice:
    """What ``compute="auto"`` chose and expects to gain.

    :param batch: entries of a minibatch
    :param threads: of torch
    :param layers: the linear layers that were measured
    :param reason: why nothing was measured; None if it was
    """

    batch: int
    threads: int
    layers: tuple[LayerChoice, ...]
    reason: str | None = None

    @property
    def compact(self) -> tuple[str, ...]:
        """Names of the layers that compute on non-zeros."""
        return tuple(layer.name for layer in self.layers if layer.compact)

    @property
    def speedup(self) -> float:
        """Expected, of the measured layers together, over masks."""
        chosen = sum(layer.chosen_seconds for layer in self.layers)
        return sum(layer.masked_seconds for layer in self.layers) / chosen if chosen else 1.0

    def table(self) -> str:
        """One line a layer: how it computes, and milliseconds masked and as chosen."""
        width = max((len(layer.name) for layer in self.layers), default=0)
        return "\n".join(
            f"  {layer.name:<{width}}  {'non-zeros' if layer.compact else 'masked   '}  "
            f"{1e3 * layer.chosen_seconds:8.3f} ms (masked {1e3 * layer.masked_seconds:.3f} ms)"
            for layer in self.layers
        )

    def __str__(self) -> str:
        if self.reason is not None:
            return f"compute='auto' keeps masks: {self.reason}"
        masked, chosen = (
            1e3 * sum(getattr(layer, kind) for layer in self.layers)
            for kind in ("masked_seconds", "chosen_seconds")
        )
        if not self.compact:
            return (
                f"compute='auto' (batch {self.batch}): masks are quicker in all "
                f"{len(self.layers)} layers measured ({masked:.2f} ms forward and backward)"
            )
        threads = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        return (
            f"compute='auto' (batch {self.batch}, {threads}): {len(self.compact)} of "
            f"{len(self.layers)} layers measured compute on non-zeros, which should take "
            f"{chosen:.2f} instead of {masked:.2f} ms forward and backward "
            f"({self.speedup:.1f} times faster)"
        )


def runs_of(root: nn.Module, layers: Iterable[SparseLayer]) -> list[list[SparseLayer]]:
    """Linear layers in groups that follow each other with nothing but activations between."""
    linear = {id(layer.module): layer for layer in layers if isinstance(layer.module, nn.Linear)}
    runs: list[list[SparseLayer]] = []
    seen: set[int] = set()
    for sequence in root.modules():
        if not isinstance(sequence, nn.Sequential):
            continue
        run: list[SparseLayer] = []
        for module in sequence:
            layer = linear.get(id(module))
            if layer is not None and id(module) not in seen:
                seen.add(id(module))
                run.append(layer)
            elif type(module) not in ELEMENTWISE and run:
                runs.append(run)
                run = []
        if run:
            runs.append(run)
    return runs + [[layer] for key, layer in linear.items() if key not in seen]


def choose(root: nn.Module, layers: Sequence[SparseLayer], batch: int) -> Choice:
    """Measure the layers that may gain and choose the quickest storage of each.

    :param root: the policy
    :param layers: its sparse layers
    :param batch: entries of a minibatch
    """
    threads = th.get_num_threads()
    missing = why_missing()
    device = next(iter(layers)).weight.device.type
    if missing is None and device != "cpu":
        missing = f"the policy is on {device}, and the kernels are for processors"
    runs = [run for run in runs_of(root, layers) if _may_gain(run)]
    if missing is None and not runs:
        missing = f"no linear layer is sparse and has {WORTH_MEASURING:,} connections or more"
    if missing is not None:
        return Choice(batch, threads, (), missing)
    chosen = [choice for run in runs for choice in _choose_run(run, batch)]
    return Choice(batch, threads, tuple(chosen))


def _may_gain(run: Sequence[SparseLayer]) -> bool:
    return any(layer.size >= WORTH_MEASURING and not layer.full for layer in run)


def _choose_run(run: Sequence[SparseLayer], batch: int) -> list[LayerChoice]:
    timings = [timing_of((layer.shape[0], layer.shape[1]), layer.nnz, batch) for layer in run]
    call = timing_of((1, 1), 1, batch).compact  # next to nothing but the call
    kinds = tuple(layer.compact for layer in run)  # what is compact stays so
    best = _seconds(run, timings, kinds, call)
    enough = WORTH_CHANGING * sum(best)
    combinations: Iterable[tuple[bool, ...]] = product(*((kind, True) for kind in kinds))
    if len(run) > LONGEST:
        combinations = [(True,) * len(run)]
    for combination in combinations:
        seconds = _seconds(run, timings, combination, call)
        if sum(seconds) < min(sum(best), enough):
            best, kinds = seconds, combination
    return [
        LayerChoice(layer.name, compact, timing.masked, seconds)
        for layer, compact, timing, seconds in zip(run, kinds, timings, best, strict=True)
    ]


def _seconds(
    run: Sequence[SparseLayer], timings: Sequence[Timing], compact: Sequence[bool], call: float
) -> list[float]:
    """Of each layer; conversions fall to compact layers beside one that is not.

    :param call: what each call of the kernels costs; compact layers that follow each other share it
    """
    found = []
    for i, (layer, timing) in enumerate(zip(run, timings, strict=True)):
        if not compact[i]:
            found.append(timing.masked)
            continue
        rows, columns = layer.shape
        share = timing.conversion / (rows + columns)
        converts_in = 0 if i and compact[i - 1] else columns
        converts_out = 0 if i + 1 < len(run) and compact[i + 1] else rows
        shared = call if i and compact[i - 1] else 0.0
        found.append(max(0.0, timing.compact - shared) + share * (converts_in + converts_out))
    return found


class AutoCompute:
    """Watches for the batch size of the first minibatches and has the storage chosen then.

    Again after pruning has halved what there was at the last choice.
    """

    def __init__(self) -> None:
        self.batch = 0
        """Entries of a minibatch; 0 as long as none was seen."""
        self.choice: Choice | None = None
        self._nnz = 0
        self._handles: list[Any] = []

    def watch(self, root: nn.Module, layers: Iterable[SparseLayer]) -> None:
        """Note the batch size at the first layer of each run, while gradients are on."""
        if self.batch or self._handles:
            return
        for run in runs_of(root, layers):
            self._handles.append(run[0].module.register_forward_pre_hook(self._note))

    def _note(self, module: nn.Module, inputs: tuple[Any, ...]) -> None:
        if th.is_grad_enabled() and isinstance(inputs[0], th.Tensor):
            self.batch = max(self.batch, inputs[0].shape[0])

    def choose(self, root: nn.Module, layers: Sequence[SparseLayer]) -> Choice | None:
        """A new choice, if it is time for one."""
        nnz = sum(layer.nnz for layer in layers)
        if not self.batch or (self.choice is not None and 2 * nnz > self._nnz):
            return None
        for handle in self._handles:
            handle.remove()
        self._handles = []
        self._nnz = nnz
        self.choice = choose(root, layers, self.batch)
        return self.choice
