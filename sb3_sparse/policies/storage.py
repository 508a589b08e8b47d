"""Which linear layers may store their active connections only.

The weight of such a layer is a vector. Whoever reads it otherwise than by calling the layer, as
attention and tied layers do, needs the matrix.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from torch import nn

from sb3_sparse.engine.storage import LayerStorage

CONTAINERS = (nn.Sequential, nn.ModuleList, nn.ModuleDict)
"""Modules of torch that do nothing with the layers in them but call them."""
KNOWN = {"stable_baselines3", "sb3_contrib", "sb3_sparse"}
"""Packages whose modules do nothing with the layers in them but call them."""


def may_be_sparse(policy: nn.Module, layers: Iterable[LayerStorage], asked_for: bool) -> set[str]:
    """Names of the layers that nobody is known to read otherwise than by calling them.

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
    return asked_for or package in KNOWN
