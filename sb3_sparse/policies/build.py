"""From a finished SB3 policy to its sparse networks."""

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
    input_layers,
    matches,
    output_layers,
)
from sb3_sparse.policies.storage import KNOWN


def build_networks(
    policy: BasePolicy,
    specs: Mapping[str, NetworkSpec],
    config: SparsityConfig,
    seed: int,
    gain: Callable[[str], float],
) -> list[SparseNetwork]:
    """Find the layers, draw masks and weights, and bring the targets in line.

    :param policy: a policy whose constructor has run to its end
    :param specs: its networks
    :param config: how sparse they shall be
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
    if config.sparsity_aware_init and config.initial_sparsity != 0.0:
        _warn_of_redrawn(policy, modules, networks)
    for network in networks:
        sparsity = sparsities[network.name]
        gains = {layer.name: gain(layer.name) for layer in network.layers}
        network.initialise(
            sparsity,
            config.initial(network.name, sparsity),
            config.distribution,
            seed,
            gains if config.sparsity_aware_init else None,
        )
    _add_targets(modules, specs, networks)
    return networks


def _warn_of_redrawn(
    policy: BasePolicy, modules: Mapping[str, nn.Module], networks: Iterable[SparseNetwork]
) -> None:
    """Say so if weights that a user's extractor came with, pretrained perhaps, are about to go.

    Where SB3 has just drawn them itself (``ortho_init``), there is nothing left of them to lose.
    """
    if getattr(policy, "ortho_init", False):
        return
    own = [
        f"{name}."
        for name, module in modules.items()
        if isinstance(module, BaseFeaturesExtractor)
        and type(module).__module__.partition(".")[0] not in KNOWN
    ]
    lost = [
        layer.name
        for network in networks
        for layer in network.layers
        if layer.name.startswith(tuple(own)) and not _as_torch_draws(layer.weight)
    ]
    if lost:
        warn(
            f"the weights of {', '.join(lost)} are drawn anew, by the connections that are there, "
            "though they are not as torch draws them. To keep weights of your own, pretrained ones "
            "for instance, masked, give policy_kwargs=dict(sparsity_aware_init=False)"
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
    """The layers of each network; one that several reach belongs to the first."""
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
            f"dense_layers has {', '.join(map(repr, sorted(unmatched)))}, which is no layer of "
            f"this policy; its layers are {', '.join(names)}, or use the words 'input' and 'output'"
        )
    return found


def _check_complete(policy: nn.Module, specs: Mapping[str, NetworkSpec], seen: set[int]) -> None:
    """Reject trained layers that belong to no network, which would stay dense unnoticed."""
    targets = tuple(f"{spec.target}." for spec in specs.values() if spec.target is not None)
    for name, module in find_prunable(policy, "", lambda _: True):
        trained = module.weight.requires_grad and not name.startswith(targets)
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
    """Give every layer its copies in the target networks, which have the same names there."""
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
