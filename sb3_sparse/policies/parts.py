"""Actors, critics and Q networks of sparse policies, which SB3's own classes can load."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from torch import nn

from sb3_sparse.engine.foreign import Guard
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.plain import make_plain
from sb3_sparse.policies.acting import Actions, Acts
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.modes import SwitchesModes
from sb3_sparse.policies.shortcut import Shortcut
from sb3_sparse.policies.vectors import from_vector, to_vector

WHOLE_POLICY = "a whole policy is copied"
"""Key of a memo of ``copy.deepcopy``."""


class SparsePart(SwitchesModes):
    """A network of a sparse policy, as ``model.actor`` or ``model.q_net``."""

    def __deepcopy__(self, memo: dict[Any, Any]) -> Any:
        memo.update(without_graphs(self))
        twin = type(self).__new__(type(self))
        memo[id(self)] = twin
        twin.__dict__.update(copy.deepcopy(self.__dict__, memo))
        if WHOLE_POLICY not in memo:  # whose controller looks after its parts
            vars(twin)["guard"] = Guard(MaskedStorage.below(twin))
        return twin

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "guard"}

    def save(self, path: Any) -> None:
        """Save the network without the policy, as in SB3, dense: 0 where it is inactive.

        ``Actor.load(path)``, with SB3's class, gives a dense network that acts the same. To keep
        masks save the policy or the model.

        :param path: file to write
        """
        twin = copy.deepcopy(self)
        make_plain(twin)
        data = twin._get_constructor_parameters()
        th.save({"state_dict": twin.state_dict(), "data": data}, path)

    def parameters_to_vector(self) -> np.ndarray[Any, Any]:
        """As in SB3; weights are dense in every storage, 0 where inactive."""
        return to_vector(self)

    def load_from_vector(self, vector: np.ndarray[Any, Any]) -> None:
        """As in SB3; what the masks have inactive stays 0, and a warning says so.

        :raises ConfigError: if the vector has another length
        """
        from_vector(self, vector)


class ActingPart(SparsePart, Acts):
    """A part that predicts by itself: an actor or a Q network."""

    paths: ClassVar[tuple[tuple[str, ...], ...]]
    """Each of its networks from the features on, by names of its modules."""
    on_the_way: ClassVar[tuple[str, ...]] = ()
    """What SB3's ``forward`` calls besides; one of the user's own gets SB3's."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._shortcut: Shortcut | None = None

    def use_kernels(self) -> None:
        """Act by the kernels from now on, where they know how."""
        self._shortcut = Shortcut(self.paths, self.on_the_way)

    def results(self, obs: Any) -> list[th.Tensor] | None:
        """What each of :attr:`paths` gives; None where modules must be called one by one."""
        if self._shortcut is None:
            return None
        return self._shortcut.results(self, obs)

    def set_training_mode(self, mode: bool) -> None:
        """As in SB3."""
        self._switch(mode)
        if not mode:  # before anybody acts with what others have written
            for layer in MaskedStorage.below(self):
                layer.notice()

    def _choose(self, observations: Actions, deterministic: bool) -> Actions | None:
        if self._shortcut is None:
            return None
        results = self._shortcut.of_array(self, observations)
        return None if results is None else self.decide(results, deterministic)

    @abstractmethod
    def decide(self, results: list[Actions], deterministic: bool) -> Actions | None:
        """Actions as SB3's ``_predict`` gives them; None where SB3 must say.

        :param results: what each of :attr:`paths` gives, shape ``(n, outputs)``
        """


class ActsByPart(Acts):
    """A policy one part of which predicts."""

    acting: ClassVar[tuple[str, ...]]

    @property
    def _acting_part(self) -> nn.Module:
        return self._modules[self.acting[0].partition(".")[0]]  # type: ignore[return-value]

    def use_kernels(self) -> None:
        part = unwrapped(self._acting_part)
        assert isinstance(part, ActingPart)
        part.use_kernels()

    def _choose(self, observations: Actions, deterministic: bool) -> Actions | None:
        part = self._acting_part
        return part._choose(observations, deterministic) if isinstance(part, ActingPart) else None


def without_graphs(root: nn.Module) -> dict[int, Any]:
    """A memo for ``copy.deepcopy`` that cuts what action distributions remember of the last batch.

    It hangs on a graph, which torch refuses to copy; every forward pass makes it anew.
    """
    return {
        id(value): _without_graph(value)
        for module in root.modules()
        for value in vars(module).values()
        if isinstance(value, Distribution)
    }


def _without_graph(distribution: Distribution) -> Distribution:
    twin = copy.copy(distribution)
    for name, value in vars(twin).items():
        if isinstance(value, th.Tensor):
            setattr(twin, name, value.detach())
        elif isinstance(value, tuple):  # of a distribution that is made later
            setattr(twin, name, tuple(part.detach() for part in value))
        elif name in ("distribution", "weights_dist"):
            setattr(twin, name, None)
    return twin
