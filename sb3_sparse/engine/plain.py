"""Modules as torch and SB3 know them: dense weights, and nothing of ours on them."""

from __future__ import annotations

from torch import nn

from sb3_sparse.engine.linear import CompactLinear
from sb3_sparse.engine.masked import MaskedLayer
from sb3_sparse.engine.sequential import ChainedSequential


def make_plain(root: nn.Module) -> None:
    """Give every layer below ``root``, a copy, its dense weight, 0 where inactive.

    Masks, hooks and classes of ours are gone afterwards. Optimizers do not follow.
    """
    for module in root.modules():
        if isinstance(module, ChainedSequential):
            module.__class__ = nn.Sequential  # type: ignore[assignment]
        elif isinstance(module, CompactLinear):
            dense = module.dense()
            module.__class__ = nn.Linear  # type: ignore[assignment]
            weight = nn.Parameter(dense, requires_grad=module.weight.requires_grad)
            for name in ("structure", "snapshot", "is_target", "listener"):
                del vars(module)[name]
            module.weight = weight
        elif (layer := MaskedLayer.of(module)) is not None:
            layer.remask()
            layer.release()
