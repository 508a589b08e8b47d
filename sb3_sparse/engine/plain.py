"""Modules as torch and SB3 know them: dense weights, and nothing of ours on them."""

from __future__ import annotations

from torch import nn

from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.sequential import ChainedSequential, unchain


def make_plain(root: nn.Module) -> None:
    """Give every layer below ``root``, a copy, its dense weight, 0 where inactive.

    Masks, hooks and classes of ours are gone afterwards. Optimizers do not follow.
    """
    for module in root.modules():
        if isinstance(module, ChainedSequential):
            unchain(module)
        elif isinstance(module, SparseLinear):
            module.to_linear()
        elif (layer := MaskedStorage.of(module)) is not None:
            layer.remask()
            layer.release()
