"""SimBa networks in place of the multilayer perceptrons that SB3 builds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from typing import Any, ClassVar

import torch as th
from torch import nn

from sb3_sparse.engine.residual import Residual
from sb3_sparse.errors import ConfigError
from sb3_sparse.networks.simba import initialise, simba
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.critics import SparseContinuousCritic, SparseCritic
from sb3_sparse.policies.modules import ActingModule


def with_simba(perceptron: nn.Sequential, has_output: bool) -> nn.Sequential:
    """Replace the hidden layers of a multilayer perceptron by a SimBa network.

    :param perceptron: linear layers, each with an activation, and perhaps an output layer
    :param has_output: whether its last linear layer is an output layer
    :raises ConfigError: if it has no hidden layer, or if they differ in width
    """
    layers: list[Any] = list(perceptron)
    hidden = sum(isinstance(layer, nn.Linear) for layer in layers) - has_output
    widths = [layers[2 * i].out_features for i in range(hidden)]
    inputs = layers[0].in_features if hidden else 0
    network = simba(inputs, widths, lambda: deepcopy(layers[1]))
    head = nn.Sequential(*layers[2 * hidden :])
    initialise(head)
    return nn.Sequential(*network, *head)


class SimbaActingModule(ActingModule):
    """Replaces the perceptrons of an actor or a Q network."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for trunk, *heads in self.paths:
            if not any(isinstance(module, Residual) for module in getattr(self, trunk)):
                setattr(self, trunk, with_simba(getattr(self, trunk), has_output=not heads))
        for head in (name for path in self.paths for name in path[1:]):
            if isinstance(getattr(self, head), nn.Module):  # with gSDE, log_std is a parameter
                initialise(getattr(self, head))


class SimbaCritic(SparseCritic):
    """Replaces the perceptrons of critics."""

    q_networks: Any

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        perceptrons: list[Any] = self.q_networks
        self.q_networks = [with_simba(q, has_output=True) for q in perceptrons]
        for number, network in enumerate(self.q_networks):
            setattr(self, f"qf{number}", network)


class SimbaContinuousCritic(SimbaCritic, SparseContinuousCritic):
    """Critics of SAC, TD3 and DDPG."""


class SimbaPolicy(BaseSparsePolicy):
    """A sparse policy of SimBa networks, to be put before a sparse policy class.

    Its defaults are ``net_arch=dict(pi=[128], qf=[256, 256])`` (``vf`` for on-policy algorithms,
    ``[256, 256]`` for Q networks) and ``optimizer_class=torch.optim.AdamW``, whose decoupled weight
    decay of 0.01 acts on all parameters; with ``weight_decay``, which acts on weights alone, it is
    off. A2C and QR-DQN hand over their own optimizers, RMSprop and Adam. Normalise observations,
    e.g. by ``VecNormalize``.

    Source: arXiv:2410.09754; ``net_arch`` as in SBX.
    """

    default_arch: ClassVar[Any] = {"pi": [128], "qf": [256, 256]}
    default_optimizer_kwargs: ClassVar[Mapping[str, Any]] = {}
    """Arguments of the default optimizer."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if kwargs.get("net_arch") is None:
            kwargs["net_arch"] = deepcopy(self.default_arch)
        self._check_arch(kwargs["net_arch"])
        if "optimizer_class" not in kwargs:
            usual = dict(self.default_optimizer_kwargs)
            if kwargs.get("weight_decay"):
                usual["weight_decay"] = 0.0
            kwargs["optimizer_class"] = th.optim.AdamW
            kwargs["optimizer_kwargs"] = {**usual, **(kwargs.get("optimizer_kwargs") or {})}
        super().__init__(*args, **kwargs)

    def _check_arch(self, net_arch: Any) -> None:
        """Reject what SB3 would read as a network without layers, or fail at."""
        by_network = isinstance(self.default_arch, Mapping)
        named = (
            isinstance(net_arch, Mapping) and by_network and net_arch.keys() == {*self.default_arch}
        )
        if not isinstance(net_arch, list) and not named:
            also = f", or a mapping such as {self.default_arch}" if by_network else ""
            raise ConfigError(
                "net_arch of a SimBa network is a list with an entry for each block, e.g. "
                f"[256, 256]{also}; got {net_arch!r}"
            )

    def _initial_gain(self, layer_name: str) -> float:
        """The gain relative to Glorot that gives a dense layer the variance of SimBa's weights."""
        if "features_extractor" in layer_name:
            return super()._initial_gain(layer_name)
        layer: Any = self.get_submodule(layer_name)
        outputs, inputs = layer.out_features, layer.in_features
        if ".residual." in layer_name:  # He normal: 2 / inputs
            return math.sqrt((inputs + outputs) / inputs)
        return math.sqrt((inputs + outputs) / 2 / max(inputs, outputs))  # orthogonal
