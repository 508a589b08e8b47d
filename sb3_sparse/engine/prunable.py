"""Layers whose weights may be sparse."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from torch import nn

from sb3_sparse.errors import UnsupportedError

Prunable = nn.Linear | nn.Conv1d | nn.Conv2d | nn.Conv3d
PRUNABLE_TYPES = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.Conv3d)
UNSUPPORTED_TYPES = (
    nn.RNNBase,
    nn.RNNCellBase,
    nn.MultiheadAttention,
    nn.Bilinear,
    nn.ConvTranspose1d,
    nn.ConvTranspose2d,
    nn.ConvTranspose3d,
)


def find_prunable(
    root: nn.Module, prefix: str, stays_dense: Callable[[str], bool]
) -> Iterator[tuple[str, Prunable]]:
    """Find every Linear and Conv layer below ``root``, in module order.

    :param root: module to search
    :param prefix: dotted name of ``root``
    :param stays_dense: whether the user wants the layer of that name dense
    :raises UnsupportedError: for a layer whose weights cannot be masked, unless it stays dense
    """
    for name, module in root.named_modules(prefix=prefix):
        if isinstance(module, UNSUPPORTED_TYPES) and not stays_dense(name):
            raise UnsupportedError(
                f"{name} is a {type(module).__name__}, whose weights cannot be made sparse (Linear "
                f'and Conv layers can); keep it dense with dense_layers=["{name}*"]'
            )
        if isinstance(module, PRUNABLE_TYPES):
            check_plain(module, name)
            yield name, module


def check_plain(module: nn.Module, name: str) -> None:
    """Reject a layer whose weight is computed from other parameters.

    :raises UnsupportedError: if so
    """
    if not isinstance(module._parameters.get("weight"), nn.Parameter):
        raise UnsupportedError(
            f"the weight of {name} is computed from other parameters (spectral_norm, weight_norm "
            "or another parametrization), so it cannot be masked; use a plain "
            f"{type(module).__name__.removeprefix('Parametrized').removeprefix('Sparse')}"
        )
