"""What a layer's FLOPs depend on besides its connections: its positions, and what is behind it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.engine.prunable import PRUNABLE_TYPES
from sb3_sparse.networks.simba import SimbaBlock
from sb3_sparse.policies.internals import space_of

PATHS = (nn.Sequential, SimbaBlock)
"""Modules that compute one after another what they hold."""
NORM_FLOPS = 5
"""FLOPs for each unit of a LayerNorm without scale and shift.

The mean, the difference from it, its square, their mean, and the product with one over the standard
deviation.
"""


def flops_per_unit(module: nn.Module) -> int | None:
    """FLOPs for each output of a layer of a module behind it; None: not counted.

    An activation function counts 1, and so does the sum of a SimBa block. A LayerNorm counts
    :data:`NORM_FLOPS`, and 1 each for its scale and its shift.
    """
    if type(module).__module__ == "torch.nn.modules.activation" or isinstance(module, SimbaBlock):
        return 1
    if isinstance(module, nn.LayerNorm):
        return NORM_FLOPS + sum(one is not None for one in (module.weight, module.bias))
    return 0 if isinstance(module, nn.Identity) else None


def flops_behind(policy: nn.Module) -> dict[int, int]:
    """FLOPs for each output of what comes directly behind each layer, by the layer's id."""
    found: dict[int, int] = {}
    entered: set[int] = set()
    for path in policy.modules():
        if id(path) in entered or not isinstance(path, PATHS):
            continue
        layer = 0
        for module in _in_order(path, entered):
            if isinstance(module, PRUNABLE_TYPES):
                layer = id(module)
                found[layer] = 0
            elif (flops := flops_per_unit(module)) is None:
                layer = 0
            elif layer:
                found[layer] += flops
    return found


def _in_order(module: nn.Module, entered: set[int]) -> Iterator[nn.Module]:
    """Modules in the order in which they compute; a residual block comes when it adds."""
    if isinstance(module, PATHS):
        entered.add(id(module))
        for child in module.children():
            yield from _in_order(child, entered)
    if not isinstance(module, nn.Sequential):
        yield module


def conv_positions(policy: BasePolicy) -> dict[int, int]:
    """Output positions of each convolution, measured in a forward pass of a zero observation."""
    positions: dict[int, int] = {}

    def note(module: nn.Module, inputs: object, output: th.Tensor) -> None:
        positions[id(module)] = math.prod(output.shape[2:])

    convs = [m for m in policy.modules() if isinstance(m, (nn.Conv1d, nn.Conv2d, nn.Conv3d))]
    if not convs:
        return positions
    handles = [conv.register_forward_hook(note) for conv in convs]
    space = policy.observation_space
    empty = _zeros(space, policy.device)
    modes = {module: module.training for module in policy.modules()}
    try:
        with th.no_grad():
            observation = preprocess_obs(empty, space, normalize_images=policy.normalize_images)
            for module in policy.modules():
                if isinstance(module, BaseFeaturesExtractor) and space_of(module) == space:
                    module.eval()(observation)
    finally:
        for handle in handles:
            handle.remove()
        for module, mode in modes.items():
            module.training = mode
    return positions


def _zeros(space: spaces.Space[Any], device: th.device) -> th.Tensor | dict[str, th.Tensor]:
    if isinstance(space, spaces.Dict):
        parts = {key: _zeros(part, device) for key, part in space.spaces.items()}
        return {key: part for key, part in parts.items() if isinstance(part, th.Tensor)}
    assert space.shape is not None
    return th.as_tensor(np.zeros((1, *space.shape), dtype=space.dtype), device=device)
