"""Reads a sparse policy's layers from its state_dict alone, running no code of the file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import torch as th
from torch import nn

from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.prunable import Prunable
from sb3_sparse.engine.residual import Residual
from sb3_sparse.engine.storage import LayerStorage
from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.networks.impala import ResidualBlock
from sb3_sparse.policies.compiled import plain_names
from sb3_sparse.policies.costs import NORM_FLOPS
from sb3_sparse.policies.registry import registered
from sb3_sparse.policies.report import LayerReport, SparsityReport
from sb3_sparse.policies.spec import NetworkSpec, in_target
from sb3_sparse.zoo.positions import positions_of

WEIGHT, MASK, BIAS = ".weight", ".weight_mask", ".bias"
CONVOLUTIONS = {3: nn.Conv1d, 4: nn.Conv2d, 5: nn.Conv3d}
SQUASHED = "actor.mu."
"""Output layers of TD3's actor and of actors with gSDE, which an activation follows."""

IMPALA_BLOCK = ".layers."
BLOCKS = ([Residual.name], [ResidualBlock.name])
"""Names of the only children of residual blocks."""


@dataclass(frozen=True)
class Outline:
    """A policy as its state_dict describes it.

    :param report: its layers, all dense or masked, as a state_dict stores them; a convolution's
        FLOPs are 0 if its strides are unknown
    :param root: modules of the same names and shapes, with activations in between
    :param layers: the layers within the budget
    """

    report: SparsityReport
    root: nn.Module
    layers: list[LayerStorage]


def outline_of(state: Mapping[str, Any], image: tuple[int, ...] | None, where: str) -> Outline:
    """Reconstruct the layers of a sparse policy.

    :param state: its state_dict
    :param image: shape of the images that it observes, channels first; None: it observes none
    :param where: the model's name in messages
    :raises ConfigError: if the policy is not sparse
    :raises CorruptStateError: if a layer has an impossible name or shape
    """
    state = plain_names(state)
    specs = _specs(state)
    networks = _networks(state, specs)
    if not any(name + MASK in state for name in networks):
        raise ConfigError(
            f"the policy in {where} is not sparse: none of its layers has a mask. Make a sparse "
            "twin of it with sb3-sparse compress"
        )
    root = nn.Module()
    layers: list[LayerStorage] = []
    reports = []
    positions = positions_of({name: tuple(state[name + WEIGHT].shape) for name in networks}, image)
    for name, network in networks.items():
        weight, mask = state[name + WEIGHT], state.get(name + MASK)
        if weight.numel() == 0:
            raise CorruptStateError(f"{where} is damaged: {name} has shape {tuple(weight.shape)}")
        try:
            module = _place(root, name, weight, name + BIAS in state)
        except KeyError as error:
            raise CorruptStateError(f"{where} is damaged: {error.args[0]}") from error
        nnz = weight.numel()
        if mask is not None:
            layer = MaskedStorage(name, module)
            layer.set_mask(mask.bool().numpy())
            layers.append(layer)
            nnz = layer.nnz
        reports.append(
            LayerReport.of(
                network,
                name,
                tuple(weight.shape),
                nnz=nnz,
                biases=weight.shape[0] if name + BIAS in state else 0,
                behind=_behind(name, state, specs),
                positions=positions.get(name, 1 if weight.dim() == 2 else 0),
                in_budget=mask is not None,
            )
        )
    _fill(root)
    order = {network: place for place, network in enumerate(dict.fromkeys(networks.values()))}
    reports.sort(key=lambda one: (order[one.network], not one.in_budget))
    return Outline(SparsityReport(tuple(reports)), root, layers)


def _specs(state: Mapping[str, Any]) -> Mapping[str, NetworkSpec]:
    """Return the networks of the first algorithm whose policy has the state's layer names."""
    for one in registered().values():
        specs = one.policy.networks
        if all(any(_below(key, spec.roots) for key in state) for spec in specs.values()):
            return specs
    return {}


def _below(name: str, roots: tuple[str, ...]) -> bool:
    return any(name.startswith(f"{root}.") for root in roots)


def _networks(state: Mapping[str, Any], specs: Mapping[str, NetworkSpec]) -> dict[str, str]:
    """Map layers to networks by name, with each weight once and without targets."""
    names = [
        key.removesuffix(WEIGHT)
        for key, value in state.items()
        if key.endswith(WEIGHT) and isinstance(value, th.Tensor) and 2 <= value.dim() <= 5
    ]
    found: dict[str, str] = {}
    seen: set[tuple[str, bytes]] = set()
    for network, spec in specs.items():
        for root in spec.roots:
            for name in names:
                if _below(name + WEIGHT, (root,)) and (one := _identity(state, name)) not in seen:
                    seen.add(one)
                    found[name] = network
    for name in names:  # layers in a custom policy's own networks
        if name + MASK in state and _identity(state, name) not in seen:
            found[name] = name.split(".")[0]
    return {name: one for name, one in found.items() if not in_target(name, specs)}


def _identity(state: Mapping[str, Any], name: str) -> tuple[str, bytes]:
    """Return a key that a shared features extractor's layer has under all of its names."""
    within = name.rpartition("features_extractor.")[2]  # the whole name of any other layer
    weight = state[name + WEIGHT].detach().contiguous()
    return within, sha256(weight.numpy().tobytes()).digest()


def _behind(name: str, state: Mapping[str, Any], specs: Mapping[str, NetworkSpec]) -> int:
    """Return the FLOPs for each output of a layer of what comes behind it."""
    sum_or_activation = _ends_residual(name, state) or _activated(name, state, specs)
    scale_and_shift = 2
    return sum_or_activation + (NORM_FLOPS + scale_and_shift) * _normalised(name, state)


def _ends_residual(name: str, state: Mapping[str, Any]) -> bool:
    """Whether a layer is the last of a residual block, so that a sum comes next."""
    module, _, number = name.rpartition(".")
    return module.endswith(".residual") and not any(
        _number(key, module) > int(number) for key in state
    )


def _normalised(name: str, state: Mapping[str, Any]) -> bool:
    """Whether a LayerNorm comes next: parameters of the same number, without statistics."""
    names = [key.removesuffix(WEIGHT) for key in state if key.endswith(WEIGHT)]
    following = names[names.index(name) + 1 :]
    if not following or f"{following[0]}.running_mean" in state:
        return False
    units = state[name + WEIGHT].shape[:1]
    norm = [state.get(following[0] + part) for part in (WEIGHT, BIAS)]
    return all(one is not None and one.shape == units for one in norm)


def _activated(name: str, state: Mapping[str, Any], specs: Mapping[str, NetworkSpec]) -> bool:
    """Whether an activation, which has no parameters, takes the number after a layer's."""
    module, _, number = name.rpartition(".")
    if not number.isdigit():
        return False
    following = f"{module}.{int(number) + 1}."
    if any(key.startswith(following) for key in state):
        return False
    inside = [key.removeprefix(module) for key in state if key.startswith(f"{module}.")]
    blocks = any(IMPALA_BLOCK in key for key in inside)
    if blocks or name.endswith(f"{IMPALA_BLOCK}3"):  # a pool follows, or the sum of the block
        return False
    last = not any(_number(key, module) > int(number) for key in state)
    heads = [head for spec in specs.values() for head in spec.heads]
    output = any(module == head or module.startswith(head.removesuffix("*")) for head in heads)
    return not (last and output) or name.startswith(SQUASHED)


def _number(key: str, module: str) -> int:
    """Return the number of a key's module in a Sequential; -1 if it is not in it."""
    rest = key.removeprefix(f"{module}.").split(".")[0] if key.startswith(f"{module}.") else ""
    return int(rest) if rest.isdigit() else -1


def _place(root: nn.Module, name: str, weight: th.Tensor, bias: bool) -> Prunable:
    """Add a layer with a weight under its dotted name."""
    *path, last = name.split(".")
    for part in path:
        if part not in dict(root.named_children()):
            root.add_module(part, nn.Module())
        root = root.get_submodule(part)
    outputs, inputs, *size = weight.shape
    layer: Prunable
    with th.device("meta"):
        if weight.dim() == 2:
            layer = nn.Linear(inputs, outputs, bias=bias)
        else:
            convolution: Any = CONVOLUTIONS[weight.dim()]
            layer = convolution(inputs, outputs, tuple(size), bias=bias)
    layer.weight = nn.Parameter(weight.detach().float())
    root.add_module(last, layer)
    return layer


def _fill(root: nn.Module) -> None:
    """Turn modules into what they were, as far as names tell.

    Numbered children are a Sequential, with an activation in each gap; an only child of the name
    that residual blocks give is what a block adds to its input.
    """
    for name, child in list(root.named_children()):
        _fill(child)
        numbers = [int(part) for part, _ in child.named_children() if part.isdigit()]
        if numbers and type(child) is nn.Module and max(numbers) < 1000:
            members = dict(child.named_children())
            filled = (members.get(str(i), nn.ReLU()) for i in range(max(numbers) + 1))
            setattr(root, name, nn.Sequential(*filled))
        elif [part for part, _ in child.named_children()] in BLOCKS and name.isdigit():
            (layers,) = child.children()
            if isinstance(layers, nn.Sequential):
                setattr(root, name, Residual(*layers))
