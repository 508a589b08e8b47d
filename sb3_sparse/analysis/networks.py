"""The networks of any SB3 policy, sparse or stock, under the same names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.plain import make_plain
from sb3_sparse.engine.prunable import PRUNABLE_TYPES, UNSUPPORTED_TYPES, Prunable
from sb3_sparse.errors import UnsupportedError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.modules import WHOLE_POLICY, copied
from sb3_sparse.policies.registry import sparse_counterpart, supported_algorithms
from sb3_sparse.policies.spec import NetworkSpec, in_target


def specs_of(policy: BasePolicy) -> Mapping[str, NetworkSpec]:
    """Where a policy keeps its networks, as its sparse counterpart declares.

    :raises UnsupportedError: for a policy without a counterpart, or with layers elsewhere
    """
    policy = unwrapped(policy)
    sparse = sparse_counterpart(policy)
    if sparse is not None:
        if not isinstance(policy, sparse):
            _check_complete(policy, sparse.networks)
        return sparse.networks
    raise UnsupportedError(
        f"the networks of {type(policy).__name__} are not known; known are the policies of "
        f"{', '.join(supported_algorithms())}"
    )


def _check_complete(policy: BasePolicy, specs: Mapping[str, NetworkSpec]) -> None:
    known = {id(module) for name in specs for module in prunable_of(policy, specs[name]).values()}
    for name, module in policy.named_modules():
        other = isinstance(module, PRUNABLE_TYPES) and id(module) not in known
        if isinstance(module, UNSUPPORTED_TYPES) or (other and not in_target(name, specs)):
            raise UnsupportedError(
                f"{name}, a {type(module).__name__} of {type(policy).__name__}, is not a Linear or "
                f"Conv layer of the networks {', '.join(map(repr, specs))}"
            )


def modules_of(policy: nn.Module, spec: NetworkSpec) -> dict[str, nn.Module]:
    """Every module of a network once, also shared ones, by dotted name."""
    named = dict(policy.named_modules(remove_duplicate=False))
    found: dict[int, tuple[str, nn.Module]] = {}
    for root in spec.roots:
        if root in named:
            for name, module in named[root].named_modules(prefix=root):
                found.setdefault(id(module), (name, module))
    return dict(found.values())


def prunable_of(policy: nn.Module, spec: NetworkSpec) -> dict[str, Prunable]:
    """Every Linear and Conv layer of a network, also shared ones, by dotted name."""
    modules = modules_of(policy, spec)
    return {name: module for name, module in modules.items() if isinstance(module, PRUNABLE_TYPES)}


def parameters_by_network(policy: BasePolicy) -> dict[str, list[str]]:
    """Names of the trained parameters; shared ones belong to the first network.

    So do parameters outside all networks, such as the ``log_std`` of PPO.
    """
    policy = unwrapped(policy)
    specs = specs_of(policy)
    names = {id(p): name for name, p in policy.named_parameters() if p.requires_grad}
    found: dict[str, list[str]] = {}
    for network, spec in specs.items():
        parameters = [p for m in modules_of(policy, spec).values() for p in m.parameters(False)]
        found[network] = [names.pop(id(p)) for p in parameters if id(p) in names]
    found[next(iter(specs))] += [name for name in names.values() if not in_target(name, specs)]
    return found


def connections(policy: BasePolicy) -> dict[str, NDArray[Any] | None]:
    """The mask of every weight, flat, by the parameter's name; None: all are active."""
    policy = unwrapped(policy)
    names = {id(p): name for name, p in policy.named_parameters()}
    found: dict[str, NDArray[Any] | None] = {}
    for spec in specs_of(policy).values():
        for module in prunable_of(policy, spec).values():
            found[names[id(module.weight)]] = None
    if isinstance(policy, BaseSparsePolicy):
        for layer in policy.sparse.layers:
            found[names[id(layer.weight)]] = layer.mask()
    return found


class _LeftOut:
    """Stands in a twin for an optimizer or a controller."""


def dense_twin(policy: BasePolicy) -> BasePolicy:
    """A copy of a policy to compute with: frozen, in evaluation mode, without optimizers.

    Every layer has a dense weight, 0 where inactive, under the same parameter name, so that
    gradients at inactive connections can be taken.
    """
    policy = unwrapped(policy)
    memo: dict[Any, Any] = {WHOLE_POLICY: True}
    for module in policy.modules():
        for value in vars(module).values():
            if isinstance(value, (th.optim.Optimizer, Controller)):
                memo[id(value)] = _LeftOut()
    twin = copied(policy, memo)
    make_plain(twin)
    for parameter in twin.parameters():
        parameter.requires_grad_(False)
    return twin.train(False)
