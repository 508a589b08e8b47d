"""Copies the parameters of a network in Flax into the same network in torch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn

from sb3_sparse.engine.residual import Residual
from sb3_sparse.errors import UnsupportedError

Tree = Mapping[str, Any]
"""Parameters by the name of a module; Flax numbers the modules of a class in order of call."""
KINDS: dict[str, str] = {
    "Linear": "Dense",
    "Conv2d": "Conv",
    "LayerNorm": "LayerNorm",
    "BatchRenorm": "BatchRenorm",
    "Residual": "SimbaResidualBlock",
    "NatureCNN": "NatureCNN",
}
"""Names of Flax's classes by those of torch's, SB3's and ours."""


def parameters(params: Any) -> Tree:
    """Return the tree of a network's parameters, of which Flax makes a part of another."""
    tree: Tree = params.get("params", params)
    return tree


def one_of(tree: Tree, number: int) -> dict[str, Any]:
    """Return the parameters of one of several networks that are stacked along the first axis."""
    return {
        name: one_of(part, number) if isinstance(part, Mapping) else np.asarray(part)[number]
        for name, part in tree.items()
    }


def fill(modules: Iterable[nn.Module], tree: Tree, statistics: Tree | None = None) -> None:
    """Copy parameters into the layers of modules, which are in order of call.

    :param tree: parameters by Flax's names, e.g. ``{"Dense_0": {"kernel": ..., "bias": ...}}``,
        where a kernel has shape ``(inputs, outputs)``, or ``(height, width, inputs, outputs)``
    :param statistics: those of normalisation, by the same names
    :raises UnsupportedError: if the networks do not have the same layers
    """
    left, seen = dict(tree), Counter[str]()
    for kind, layer in _layers(modules):
        name = f"{kind}_{seen[kind]}"
        seen[kind] += 1
        if name not in left:
            raise UnsupportedError(
                f"the network of SBX has no {name}, which the one of SB3 has, so it cannot be "
                f"translated; it has {', '.join(tree)}"
            )
        _copy(kind, layer, left.pop(name), (statistics or {}).get(name, {}))
    if left:
        raise UnsupportedError(
            f"the network of SBX has {', '.join(left)}, which the one of SB3 has not, so it cannot "
            "be translated"
        )


def put(tensor: th.Tensor, values: Any, name: str) -> None:
    """Copy values into a tensor.

    :raises UnsupportedError: if the shapes differ
    """
    array = np.array(values)
    if tensor.shape != array.shape:
        raise UnsupportedError(
            f"{name} of SBX has shape {array.shape}, the one of SB3 {tuple(tensor.shape)}, so it "
            "cannot be translated"
        )
    with th.no_grad():
        tensor.copy_(th.from_numpy(array))


def _layers(modules: Iterable[nn.Module]) -> Iterator[tuple[str, nn.Module]]:
    for module in modules:
        names = [cls.__name__ for cls in type(module).__mro__]
        kind = next((KINDS[name] for name in names if name in KINDS), None)
        if kind is None:
            yield from _layers(module.children())
        else:
            yield kind, module


def _copy(kind: str, layer: Any, part: Tree, statistics: Tree) -> None:
    """Copy the parameters of one layer, or of a block of layers."""
    if isinstance(layer, Residual):
        fill(layer.children(), part)
    elif isinstance(layer, NatureCNN):
        fill(layer.children(), _channels_first(part))
    elif kind in ("Dense", "Conv"):
        axes = (1, 0) if kind == "Dense" else (3, 2, 0, 1)
        put(layer.weight, np.transpose(part["kernel"], axes), f"the kernel of a {kind}")
        put(layer.bias, part["bias"], f"the bias of a {kind}")
    elif kind == "LayerNorm":
        put(layer.weight, part["scale"], "the scale of a LayerNorm")
        put(layer.bias, part["bias"], "the bias of a LayerNorm")
    else:
        for name, values in (("scale", part["scale"]), ("bias", part["bias"])):
            put(getattr(layer, name), values, f"the {name} of a BatchRenorm")
        for name, theirs in (("ra_mean", "mean"), ("ra_var", "var"), ("steps", "steps")):
            put(getattr(layer, name), statistics[theirs], f"the {theirs} of a BatchRenorm")


def _channels_first(tree: Tree) -> dict[str, Any]:
    """Reorder the inputs of the linear layer after convolutions: channels last in JAX."""
    channels = np.shape(tree["Conv_2"]["bias"])[0]
    kernel = np.asarray(tree["Dense_0"]["kernel"])
    places = kernel.reshape(-1, channels, kernel.shape[1]).swapaxes(0, 1)
    return {**tree, "Dense_0": {**tree["Dense_0"], "kernel": places.reshape(kernel.shape)}}
