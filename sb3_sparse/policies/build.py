"""Builds the sparse networks of a finished SB3 policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.engine.prunable import PRUNABLE_TYPES, find_prunable
from sb3_sparse.errors import ConfigError, UnsupportedError, warn
from sb3_sparse.policies.config import SparsityConfig
from sb3_sparse.policies.spec import (
    DENSE_WORDS,
    NetworkLayers,
    NetworkSpec,
    in_target,
    input_layers,
    matches,
    output_layers,
)
from sb3_sparse.policies.storage import is_known


def build_networks(
    policy: BasePolicy,
    specs: Mapping[str, NetworkSpec],
    config: SparsityConfig,
    seed: int,
    gain: Callable[[str], float],
) -> list[SparseNetwork]:
    """Find the layers, draw masks and weights, and copy both to the target networks.

    :param policy: a policy whose SB3 constructor has finished
    :param specs: where it keeps its networks
    :param config: the sparse arguments
    :param seed: mask seed
    :param gain: SB3's initial gain of a layer, by its name
    :raises ConfigError: if the configuration does not fit the policy
    :raises UnsupportedError: for layers that cannot be made sparse
    """
    modules = dict(policy.named_modules(remove_duplicate=False))
    found = _find_layers(policy, modules, specs, config)
    networks = [
        SparseNetwork(
            name,
            modules[specs[name].owner],
            prunable=found[name].sparse,
            dense_layers=found[name].dense,
        )
        for name in specs
    ]
    sizes = {network.name: network.size for network in networks}
    for name, size in sizes.items():
        if size == 0:
            raise ConfigError(
                f"dense_layers={list(config.dense_layers)} leaves nothing to make sparse in "
                f"{name!r}"
            )
    sparsities = config.by_network(sizes)
    starts = {name: config.initial(name, final) for name, final in sparsities.items()}
    if config.sparsity_aware_init:
        _warn_of_redrawn(policy, modules, [n for n in networks if starts[n.name] != 0.0])
    for network in networks:
        gains = {layer.name: gain(layer.name) for layer in network.layers}
        network.initialise(
            sparsities[network.name],
            starts[network.name],
            config.distribution,
            seed,
            gains if config.sparsity_aware_init else None,
        )
    _add_targets(modules, specs, networks)
    return networks


def _warn_of_redrawn(
    policy: BasePolicy, modules: Mapping[str, nn.Module], networks: Iterable[SparseNetwork]
) -> None:
    """Warn if the weights of a user's own extractor, perhaps pretrained, are about to be lost.

    With ``ortho_init`` SB3 has drawn them anew already.
    """
    if getattr(policy, "ortho_init", False):
        return
    own = [
        f"{name}."
        for name, module in modules.items()
        if isinstance(module, BaseFeaturesExtractor) and not is_known(type(module))
    ]
    lost = [
        layer.name
        for network in networks
        for layer in network.layers
        if layer.name.startswith(tuple(own)) and not _as_torch_draws(layer.weight)
    ]
    if lost:
        warn(
            f"the weights of {', '.join(lost)} are drawn anew for their connections, though they "
            "do not look as torch initialises them. To keep your own weights, for instance "
            "pretrained ones, and mask them, give policy_kwargs=dict(sparsity_aware_init=False)"
        )


def _as_torch_draws(weight: nn.Parameter) -> bool:
    """Whether all weights lie within the bound of ``nn.Linear`` and ``nn.Conv2d`` by default."""
    fan_in = weight[0].numel()
    return bool(weight.detach().abs().max() <= 1.0001 / math.sqrt(fan_in))


def _find_layers(
    policy: nn.Module,
    modules: Mapping[str, nn.Module],
    specs: Mapping[str, NetworkSpec],
    config: SparsityConfig,
) -> dict[str, NetworkLayers]:
    """The layers of each network; a layer that several networks contain belongs to the first."""
    patterns = config.dense_layers
    seen: set[int] = set()
    found = {name: NetworkLayers() for name in specs}
    unmatched = set(patterns)
    for network, spec in specs.items():
        layers = {}
        for root in spec.roots:
            if root not in modules:
                continue
            for name, module in find_prunable(
                modules[root], root, lambda name: matches(name, patterns)
            ):
                if id(module.weight) not in seen:
                    seen.add(id(module.weight))
                    layers[name] = module
        words = {
            "input": input_layers(policy, spec, list(layers)),
            "output": output_layers(spec, list(layers)),
        }
        for name, module in layers.items():
            fits = {p for p in patterns if matches(name, [p])}
            fits |= {word for word in DENSE_WORDS if word in patterns and name in words[word]}
            unmatched -= fits
            left_dense = fits or not module.weight.requires_grad
            kind = found[network].dense if left_dense else found[network].sparse
            kind.append((name, module))
    _check_complete(policy, specs, seen)
    if unmatched:
        names = [name for layers in found.values() for name, _ in layers.sparse + layers.dense]
        raise ConfigError(
            f"dense_layers has {', '.join(map(repr, sorted(unmatched)))}, which matches no layer "
            f"of this policy; its layers are {', '.join(names)}, or use the words 'input' and "
            "'output'"
        )
    return found


def _check_complete(policy: nn.Module, specs: Mapping[str, NetworkSpec], seen: set[int]) -> None:
    """Reject trained layers that belong to no network and would silently stay dense."""
    for name, module in find_prunable(policy, "", lambda _: True):
        trained = module.weight.requires_grad and not in_target(name, specs)
        if trained and id(module.weight) not in seen:
            raise UnsupportedError(
                f"{name} belongs to none of the networks {', '.join(map(repr, specs))} of "
                f"{type(policy).__name__}; name it, or a module around it, among the roots of one "
                "in the class attribute `networks`"
            )


def _add_targets(
    modules: Mapping[str, nn.Module],
    specs: Mapping[str, NetworkSpec],
    networks: Iterable[SparseNetwork],
) -> None:
    """Tell every layer its copy in the target network, which has the same name there."""
    layers = {id(layer.weight): layer for network in networks for layer in network.layers}
    done: set[int] = set()
    for spec in specs.values():
        if spec.target is None:
            continue
        (root,) = spec.roots
        for name, module in modules[root].named_modules():
            if not isinstance(module, PRUNABLE_TYPES):
                continue
            layer = layers.get(id(module.weight))
            target = modules[f"{spec.target}.{name}"]
            if target is module:
                raise UnsupportedError(
                    f"{root}.{name} is one and the same module as {spec.target}.{name}, so the "
                    "target would move with the network; build a new module each time the features "
                    "extractor is made, or hand it in through features_extractor_kwargs, which are "
                    "copied"
                )
            if layer is None or id(target) in done:
                continue
            assert isinstance(target, PRUNABLE_TYPES)
            done.add(id(target))
            assert isinstance(layer, MaskedStorage)
            layer.add_target(target)
