"""Turns sparse modules into plain ones."""

from __future__ import annotations

from torch import nn

from sb3_sparse.engine.layer import SparseLayer
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.sequential import ChainedSequential, unchain


def make_plain(root: nn.Module) -> None:
    """Give every layer below ``root`` its dense weight back, 0 where inactive.

    This removes the masks, hooks and classes of this package. Optimizers do not follow, so apply it
    to copies.
    """
    for module in root.modules():
        if isinstance(module, ChainedSequential):
            unchain(module)
        elif isinstance(module, SparseLayer):
            module.to_dense()
        elif (layer := MaskedStorage.of(module)) is not None:
            layer.remask()
            layer.release()
