"""The moments that optimizers keep of a layer's weight."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_sparse.engine.storage import LayerStorage


def moments_of(
    optimizers: Sequence[th.optim.Optimizer], weight: nn.Parameter
) -> list[tuple[dict[str, Any], str, th.Tensor]]:
    """Find the moments of ``weight``: each with the state and the key under which it is kept.

    They are the tensors that have dimensions: Adam's two moments, a momentum buffer, but no step
    count.
    """
    return [
        (state, key, value)
        for optimizer in optimizers
        if (state := optimizer.state.get(weight))
        for key, value in state.items()
        if isinstance(value, th.Tensor) and value.dim()
    ]


def clear_moments(
    weight: nn.Parameter, where: NDArray[np.bool_], optimizers: Sequence[th.optim.Optimizer]
) -> None:
    """Set the moments of some entries of a parameter to 0.

    :param where: which entries, as many as the parameter has
    """
    places = th.from_numpy(where).view(weight.shape).to(weight.device)
    for _, _, value in moments_of(optimizers, weight):
        if value.shape == weight.shape:
            value.masked_fill_(places, 0.0)


def save_moments(
    optimizer: th.optim.Optimizer, state_dict: dict[str, Any], layers: Iterable[LayerStorage]
) -> None:
    """Write moments of sparse layers into an optimizer's state_dict as masked layers have them."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    numbers = {id(parameter): number for number, parameter in enumerate(parameters)}
    for layer in layers:
        number = numbers.get(id(layer.weight))
        if layer.is_sparse and number in state_dict["state"]:
            state_dict["state"][number] = {
                key: layer.saved_moment(value) if isinstance(value, th.Tensor) else value
                for key, value in state_dict["state"][number].items()
            }
