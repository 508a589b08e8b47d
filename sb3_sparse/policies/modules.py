"""Actors, critics and Q networks of sparse policies, which SB3's own classes can load."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.distributions import Distribution
from torch import nn

from sb3_sparse.engine.foreign import Guard
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.plain import make_plain
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.fast_forward import FastForward
from sb3_sparse.policies.fast_predict import Actions, FastPredict
from sb3_sparse.policies.training_mode import FastModeSwitch
from sb3_sparse.policies.vectors import DenseVectors

Module = TypeVar("Module", bound=nn.Module)
WHOLE_POLICY = "a whole policy is copied"
"""Key in the memo of ``copy.deepcopy``."""


class SparseModule(DenseVectors, FastModeSwitch):
    """A module of a sparse policy that SB3 also uses by itself, as ``model.actor``."""

    def __deepcopy__(self, memo: dict[Any, Any]) -> Any:
        twin = copied(self, memo)
        if WHOLE_POLICY not in memo:  # else the policy's controller guards the masks
            vars(twin)["guard"] = Guard(MaskedStorage.below(twin))
        return twin

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "guard"}

    def save(self, path: Any) -> None:
        """Save the module without the policy, as in SB3, with dense weights, 0 where inactive.

        ``Actor.load(path)`` of SB3's own class gives a dense module that acts the same; a SimBa
        network is loaded by its own class. Save the policy or the model to keep the masks.

        :param path: file to write
        """
        twin = copy.deepcopy(self)
        make_plain(twin)
        data = twin._get_constructor_parameters()
        th.save({"state_dict": twin.state_dict(), "data": data}, path)


class ActingModule(SparseModule, FastPredict):
    """A module that predicts: an actor or a Q network."""

    paths: ClassVar[tuple[tuple[str, ...], ...]]
    """Names of the modules of each of its networks, from the features to the output."""
    bypassed: ClassVar[tuple[str, ...]] = ()
    """Methods that SB3's ``forward`` calls besides ``extract_features``. Where a user overrides
    one, SB3's ``forward`` runs."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._fast_forward: FastForward | None = None

    def use_kernels(self) -> None:
        """Compute actions in the kernels from now on, where they can."""
        self._fast_forward = FastForward(self.paths, self.bypassed)

    def results(self, obs: Any) -> list[th.Tensor] | None:
        """The output of each of :attr:`paths`; None: the modules have to be called."""
        if self._fast_forward is None:
            return None
        return self._fast_forward.results(self, obs)

    def set_training_mode(self, mode: bool) -> None:
        """As in SB3."""
        self._switch(mode)
        if not mode:  # users may have written to weights
            for layer in MaskedStorage.below(self):
                layer.remask_if_written()

    def _fast_actions(self, observations: Actions, deterministic: bool) -> Actions | None:
        if self._fast_forward is None:
            return None
        results = self._fast_forward.from_numpy(self, observations)
        return None if results is None else self.actions_from(results, deterministic)

    @abstractmethod
    def actions_from(self, results: list[Actions], deterministic: bool) -> Actions | None:
        """Actions as SB3's ``_predict`` returns them; None: SB3 has to compute them.

        :param results: the output of each of :attr:`paths`, shape ``(n, outputs)``
        """


class PredictsByModule(FastPredict):
    """A policy that predicts with one of its modules, the first of :attr:`acting`."""

    acting: ClassVar[tuple[str, ...]]

    @property
    def _acting_module(self) -> nn.Module:
        return self._modules[self.acting[0].partition(".")[0]]  # type: ignore[return-value]

    def use_kernels(self) -> None:
        acting = unwrapped(self._acting_module)
        assert isinstance(acting, ActingModule)
        acting.use_kernels()

    def _fast_actions(self, observations: Actions, deterministic: bool) -> Actions | None:
        acting = self._acting_module
        if not isinstance(acting, ActingModule):
            return None  # it is compiled
        return acting._fast_actions(observations, deterministic)


def copied(root: Module, memo: dict[Any, Any]) -> Module:
    """A deep copy in which action distributions are cut off the graph of the last batch.

    Torch cannot copy tensors that belong to a graph. Every forward pass sets them anew.

    :param memo: as in ``copy.deepcopy``
    """
    for module in root.modules():
        for value in vars(module).values():
            if isinstance(value, Distribution):
                memo[id(value)] = _without_graph(value)
    twin = type(root).__new__(type(root))
    memo[id(root)] = twin
    twin.__dict__.update(copy.deepcopy(root.__dict__, memo))
    return twin


def _without_graph(distribution: Distribution) -> Distribution:
    twin = copy.copy(distribution)
    for name, value in vars(twin).items():
        if isinstance(value, th.Tensor):
            setattr(twin, name, value.detach())
        elif isinstance(value, tuple):  # parameters of a LazyDistribution
            setattr(twin, name, tuple(part.detach() for part in value))
        elif name in ("distribution", "weights_dist"):
            setattr(twin, name, None)
    return twin
