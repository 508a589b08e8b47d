"""Which layers may store only their active connections.

The weight of such a layer is a vector. Code that reads the weight instead of calling the layer, as
attention and tied layers do, needs the dense weight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from torch import nn

from sb3_sparse.engine.storage import LayerStorage

CONTAINERS = (nn.Sequential, nn.ModuleList, nn.ModuleDict)
"""Modules of torch that only call the layers in them."""
KNOWN_PACKAGES = {"stable_baselines3", "sb3_contrib", "sb3_sparse"}
"""Packages whose modules only call the layers in them."""


def may_be_sparse(policy: nn.Module, layers: Iterable[LayerStorage], asked_for: bool) -> set[str]:
    """Names of the layers that are only ever called, as far as is known.

    :param policy: the policy that the layers belong to
    :param layers: its sparse layers
    :param asked_for: whether the user asked for sparse storage: then modules of the user's own are
        taken to call their layers; otherwise nothing is known of them
    """
    uses = Counter(
        id(parameter) for module in policy.modules() for parameter in module._parameters.values()
    )
    found = set()
    for layer in layers:
        around: list[nn.Module] = [policy]
        for name in layer.name.split(".")[:-1]:
            around.append(around[-1].get_submodule(name))
        called = all(_only_calls(module, asked_for) for module in around)
        if called and uses[id(layer.weight)] == 1:
            found.add(layer.name)
    return found


def _only_calls(module: nn.Module, asked_for: bool) -> bool:
    package = type(module).__module__.partition(".")[0]
    if package == "torch":
        return isinstance(module, CONTAINERS)
    return asked_for or is_known(type(module))


def is_known(code: Any) -> bool:
    """Whether a class or function belongs to one of :data:`KNOWN_PACKAGES`."""
    package: str = code.__module__.partition(".")[0]
    return package in KNOWN_PACKAGES
