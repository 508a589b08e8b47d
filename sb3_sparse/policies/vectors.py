"""All parameters as one vector with dense weights, as SB3's evolution strategies use it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BaseModel
from torch import nn

from sb3_sparse.engine.layer import SparseLayer
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.errors import ConfigError, warn


class DenseVectors(BaseModel):
    """A policy, or a module of one, with SB3's methods for parameters as one vector."""

    def parameters_to_vector(self) -> NDArray[np.float32]:
        """As in SB3; weights are dense in every storage, 0 where inactive.

        :return: shape ``(n,)``, where ``n`` is the number of parameters of the dense network
        """
        layers = _layers(self)
        parts = []
        for parameter in self.parameters():
            layer = layers.get(id(parameter))
            if isinstance(layer, MaskedStorage):
                layer.remask()
            dense = layer.dense() if isinstance(layer, SparseLayer) else parameter.detach()
            parts.append(dense.reshape(-1).cpu().numpy())
        return np.concatenate(parts)

    def load_from_vector(self, vector: NDArray[Any]) -> None:
        """As in SB3; inactive connections stay 0, and a warning counts the values dropped.

        :param vector: of :meth:`parameters_to_vector`, with any storage and any mask
        :raises ConfigError: if it has another shape; nothing is loaded then
        """
        values = th.as_tensor(vector, dtype=th.float32)
        layers = _layers(self)
        parameters = list(self.parameters())
        sizes = [_size(parameter, layers.get(id(parameter))) for parameter in parameters]
        if values.shape != (sum(sizes),):
            raise ConfigError(
                f"the vector has the shape {tuple(values.shape)}; {type(self).__name__} takes "
                f"({sum(sizes)},): every parameter of the dense network, as parameters_to_vector() "
                "gives them, with 0 where a connection is inactive"
            )
        dropped = 0
        for parameter, part in zip(parameters, th.split(values, sizes), strict=True):
            layer = layers.get(id(parameter))
            if layer is None:
                with th.no_grad():
                    parameter.copy_(part.view_as(parameter))
                continue
            if isinstance(layer, SparseLayer):
                layer.take_saved(part.clone())
                kept = layer.dense()
            else:
                layer.write(part)
                kept = parameter.detach()
            dropped += int(part.count_nonzero() - kept.count_nonzero())
        if dropped:
            warn(
                f"{dropped} of the vector's values belong to inactive connections and were "
                "dropped; inactive connections stay 0"
            )


def _layers(root: nn.Module) -> dict[int, SparseLayer | MaskedStorage]:
    """The sparse layer that each weight belongs to, by the weight's id."""
    found: dict[int, SparseLayer | MaskedStorage] = {}
    for module in root.modules():
        if isinstance(module, SparseLayer):
            found[id(module.weight)] = module
        elif (layer := MaskedStorage.of(module)) is not None:
            found[id(layer.weight)] = layer
    return found


def _size(parameter: nn.Parameter, layer: SparseLayer | MaskedStorage | None) -> int:
    if isinstance(layer, SparseLayer):
        return math.prod(layer.dense_shape)
    return parameter.numel()
