"""SimBa networks in place of the multilayer perceptrons that SB3 builds."""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Any, ClassVar

import torch as th
from torch import nn

from sb3_sparse.networks.simba import initialise, simba
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.critics import SparseContinuousCritic, SparseCritic
from sb3_sparse.policies.modules import ActingModule


def with_simba(perceptron: nn.Sequential, hidden: int) -> nn.Sequential:
    """Replace the hidden layers of a multilayer perceptron by a SimBa network.

    :param perceptron: linear layers, each with an activation, and perhaps an output layer
    :param hidden: number of its hidden layers
    :raises ConfigError: if there are none, or if they differ in width
    """
    layers: list[Any] = list(perceptron)
    widths = [layers[2 * i].out_features for i in range(hidden)]
    activation = type(layers[1]) if hidden else nn.ReLU
    inputs = layers[0].in_features if hidden else 0
    network = simba(inputs, widths, activation)
    head = nn.Sequential(*layers[2 * hidden :])
    initialise(head)
    return nn.Sequential(*network, *head)


class SimbaActingModule(ActingModule):
    """An actor or a Q network that is a SimBa network."""

    net_arch: list[int]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for trunk in dict.fromkeys(path[0] for path in self.paths):
            setattr(self, trunk, with_simba(getattr(self, trunk), len(self.net_arch)))
        for head in (name for path in self.paths for name in path[1:]):
            if isinstance(getattr(self, head), nn.Module):  # with gSDE, log_std is a parameter
                initialise(getattr(self, head))


class SimbaCritic(SparseCritic):
    """Critics that are SimBa networks."""

    q_networks: Any

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        perceptrons: list[Any] = self.q_networks
        self.q_networks = [with_simba(q, sum(map(_is_linear, q)) - 1) for q in perceptrons]
        for number, network in enumerate(self.q_networks):
            setattr(self, f"qf{number}", network)


class SimbaContinuousCritic(SimbaCritic, SparseContinuousCritic):
    """Critics of SAC, TD3 and DDPG that are SimBa networks."""


def _is_linear(module: nn.Module) -> bool:
    return isinstance(module, nn.Linear)


class SimbaPolicy(BaseSparsePolicy):
    """A sparse policy of SimBa networks, to be put before a sparse policy class.

    Its defaults are ``net_arch=dict(pi=[128], qf=[256, 256])`` (``vf`` for on-policy algorithms,
    ``[256, 256]`` for Q networks) and ``optimizer_class=torch.optim.AdamW``, whose decoupled weight
    decay of 0.01 acts on all parameters. Normalise observations, e.g. by ``VecNormalize``.

    Source: arXiv:2410.09754; ``net_arch`` as in SBX.
    """

    default_arch: ClassVar[Any] = {"pi": [128], "qf": [256, 256]}

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("net_arch", deepcopy(self.default_arch))
        kwargs.setdefault("optimizer_class", th.optim.AdamW)
        super().__init__(*args, **kwargs)

    def _initial_gain(self, layer_name: str) -> float:
        """The gain relative to Glorot that gives a dense layer the variance of SimBa's weights."""
        if "features_extractor" in layer_name:
            return super()._initial_gain(layer_name)
        weight: Any = self.get_submodule(layer_name).weight
        outputs, inputs = weight.shape
        if ".residual." in layer_name:  # He normal: 2 / inputs
            return math.sqrt((inputs + outputs) / inputs)
        return math.sqrt((inputs + outputs) / 2 / max(inputs, outputs))  # orthogonal
