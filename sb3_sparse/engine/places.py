"""Checks that sparse layers are still in their policy."""

from __future__ import annotations

from collections.abc import Iterable

from torch import nn

from sb3_sparse.engine.internals import WRAPPED
from sb3_sparse.engine.layer import MASK_KEY
from sb3_sparse.engine.storage import LayerStorage
from sb3_sparse.errors import UnsupportedError


def check_places(root: nn.Module, layers: Iterable[LayerStorage]) -> None:
    """Reject a policy in which a sparse layer has been replaced by another module.

    :param root: the policy
    :param layers: its sparse layers
    :raises UnsupportedError: if one has been replaced, or has lost its mask
    """
    for layer in layers:
        if _module_at(root, layer.name) is not layer.module:
            raise UnsupportedError(
                f"{layer.name} was replaced after the policy had been made, so the new module is "
                "neither sparse nor counted; copy new weights into the layer that is there "
                "(load_state_dict, copy_), or make a policy that has the new layer from the "
                "beginning (net_arch, features_extractor_class or a subclass)"
            )
        if not layer.is_sparse and MASK_KEY not in layer.module._buffers:
            raise UnsupportedError(
                f"the mask of {layer.name} was taken away, as torch.nn.utils.prune does, which has "
                "one of the same name; prune with SparsityCallback('prune') or sb3_sparse.sparsify"
            )


def _module_at(root: nn.Module, name: str) -> nn.Module | None:
    """Find the module at a dotted name, also within modules that ``torch.compile`` has wrapped."""
    module: nn.Module | None = root
    for part in name.split("."):
        module = None if module is None else module._modules.get(part)
        if module is not None and WRAPPED in module._modules:
            module = module._modules[WRAPPED]
    return module
