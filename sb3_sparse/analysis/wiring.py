"""Which layers write and read the units of each activation function."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn

from sb3_sparse.analysis.activity import is_activation, run_network, tensors_of
from sb3_sparse.analysis.networks import dense_twin, modules_of, specs_of
from sb3_sparse.engine.internals import pytree
from sb3_sparse.engine.prunable import PRUNABLE_TYPES

STEP = 2.0**-20
"""Distance of two labels; labels lie in (1, 2), so that the sum of two is none."""


@dataclass
class Wiring:
    """The layers around the units of one activation function.

    :param units: number of units: features, or channels of images
    :param incoming: name of the layer whose outputs are the units before activation
    :param outgoing: layers that read the units: for each of their inputs the number of the unit,
        or -1 for an input that is none of these
    """

    units: int
    incoming: str
    outgoing: dict[str, NDArray[np.int64]] = field(default_factory=dict)


def wiring_of(policy: BasePolicy, observations: Any) -> dict[str, Wiring]:
    """Find the hidden units of all networks, by the name of their activation function.

    It is found by trial: every activation function returns a label for each unit in place of its
    value, and layers that meet the labels read these units, whether they were flattened or joined
    with other features on the way. Units that no single layer writes, such as those of sums, and
    units that no layer reads, such as actions, are left out.

    :param policy: an SB3 policy, sparse or stock; it does not change
    :param observations: one or more
    """
    twin = dense_twin(policy)
    tensors = pytree.tree_map(lambda leaf: leaf[:1], tensors_of(twin, observations))
    trial = _Trial()
    seen: set[int] = set()
    for spec in specs_of(twin).values():
        for name, module in modules_of(twin, spec).items():
            if id(module) not in seen:
                seen.add(id(module))
                trial.watch(name, module)
    # Actions among a critic's inputs are not units, so they are zeros here.
    actions = th.zeros((1, get_action_dim(twin.action_space)), device=twin.device)
    with th.no_grad():
        for network in specs_of(twin):
            run_network(twin, network, tensors, actions)
    return trial.found()


class _Trial:
    """Hooks on a twin's modules, and what they have seen."""

    def __init__(self) -> None:
        self.writers: dict[int, tuple[str, th.Tensor]] = {}
        """Layer of each tensor that has the outputs of one, by the id of the tensor."""
        self.units: dict[str, tuple[int, int, str | None]] = {}
        """First label, number of units and writer, by activation function."""
        self.again: set[str] = set()
        self.read: dict[str, th.Tensor] = {}
        self.labels = 0

    def watch(self, name: str, module: nn.Module) -> None:
        """Register the hook for a module's kind."""
        if isinstance(module, PRUNABLE_TYPES):
            module.register_forward_hook(partial(self._layer, name))
        elif is_activation(module):
            module.register_forward_hook(partial(self._activation, name))
        elif not list(module.children()) and all(p.dim() < 2 for p in module.parameters()):
            module.register_forward_hook(self._passed)

    def _layer(self, name: str, module: nn.Module, inputs: Any, output: th.Tensor) -> None:
        self.read.setdefault(name, inputs[0])
        self.writers[id(output)] = name, output

    def _passed(self, module: nn.Module, inputs: Any, output: Any) -> Any:
        """Let units pass through normalisation, dropout and the like."""
        units = inputs[0] if inputs else None
        if isinstance(units, th.Tensor) and isinstance(output, th.Tensor):
            return units if units.shape == output.shape else None
        return None

    def _activation(
        self, name: str, module: nn.Module, inputs: Any, output: th.Tensor
    ) -> th.Tensor:
        count = output.shape[1]
        if name not in self.units:
            known = self.writers.get(id(inputs[0]))
            self.units[name] = self.labels, count, known[0] if known else None
            self.labels += count
        elif self.units[name][2] != self.writers.get(id(inputs[0]), (None,))[0]:
            self.again.add(name)  # one module for the units of several layers
        first = self.units[name][0]
        labels = 1.0 + STEP * th.arange(first + 1, first + count + 1, device=output.device)
        shape = (1, count, *[1] * (output.dim() - 2))
        return labels.to(output.dtype).view(shape).expand_as(output)

    def found(self) -> dict[str, Wiring]:
        """Match the labels that layers have read."""
        found = {}
        read = {name: _labels(x) for name, x in self.read.items()}
        for name, (first, count, incoming) in self.units.items():
            if incoming is None or name in self.again:
                continue
            wiring = Wiring(count, incoming)
            for layer, labels in read.items():
                units = np.where((labels >= first) & (labels < first + count), labels - first, -1)
                if len(np.unique(units[units >= 0])) == count:
                    wiring.outgoing[layer] = units
            if wiring.outgoing:
                found[name] = wiring
        return found


def _labels(inputs: th.Tensor) -> NDArray[np.int64]:
    """Return the label of each input of a layer; -1 where there is none."""
    values = inputs[0].double().flatten(1) if inputs.dim() > 2 else inputs[0].double()[:, None]
    steps = (values - 1.0) / STEP - 1.0
    first = steps[:, 0].round()
    is_label = ((steps == first[:, None]) & (first[:, None] >= 0)).all(dim=1)
    found: NDArray[np.int64] = th.where(is_label, first, -1.0).long().cpu().numpy()
    return found
