"""Actors, critics and Q networks of sparse policies, which SB3's own classes can load."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import BaseModel
from torch import nn

from sb3_sparse.engine.plain import make_plain
from sb3_sparse.policies.vectors import from_vector, to_vector


class SparsePart(BaseModel):
    """A network of a sparse policy, as ``model.actor`` or ``model.q_net``."""

    def save(self, path: Any) -> None:
        """Save the network without the policy, as in SB3, dense: 0 where it is inactive.

        ``Actor.load(path)``, with SB3's class, gives a dense network that acts the same. To keep
        masks save the policy or the model.

        :param path: file to write
        """
        twin = copy.deepcopy(self, without_graphs(self))
        make_plain(twin)
        data = twin._get_constructor_parameters()
        th.save({"state_dict": twin.state_dict(), "data": data}, path)

    def parameters_to_vector(self) -> np.ndarray[Any, Any]:
        """As in SB3; kernels are dense in every storage, 0 where inactive."""
        return to_vector(self)

    def load_from_vector(self, vector: np.ndarray[Any, Any]) -> None:
        """As in SB3; what the masks have inactive stays 0, and a warning says so.

        :raises ConfigError: if the vector has another length
        """
        from_vector(self, vector)


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
        elif name in ("distribution", "weights_dist"):
            setattr(twin, name, None)
    return twin
