"""Optimizers with the settings that masked training wants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch as th

from sb3_sparse.errors import ConfigError

FUSED_BY_DEFAULT = (th.optim.Adam, th.optim.AdamW)


def check_weight_decay(weight_decay: float, optimizer_kwargs: Mapping[str, Any] | None) -> float:
    """Return ``weight_decay`` as a float.

    :raises ConfigError: if it is negative or no number, or if the optimizer was given one as well
    """
    if isinstance(weight_decay, bool) or not isinstance(weight_decay, (int, float)):
        raise ConfigError(f"weight_decay must be a number, 0 or more, got {weight_decay!r}")
    if not 0.0 <= weight_decay < float("inf"):
        raise ConfigError(f"weight_decay must be 0 or more, got {weight_decay}")
    if weight_decay and (optimizer_kwargs or {}).get("weight_decay"):
        raise ConfigError(
            "weight_decay is given twice: as a policy argument (kernels only) and in "
            "optimizer_kwargs (all parameters); keep one"
        )
    return float(weight_decay)


def rebuild(
    optimizer: th.optim.Optimizer,
    optimizer_kwargs: Mapping[str, Any],
    kernels: Iterable[th.Tensor],
    weight_decay: float,
) -> th.optim.Optimizer:
    """The same optimizer, before its first step, fused and with weight decay on kernels only.

    Adam is fused unless the user chose ``fused``, ``foreach``, ``capturable`` or
    ``differentiable``: eager Adam takes square roots of second moments, which are slow on the exact
    zeros of a masked weight. Anything else about the optimizer stays as it is.

    :param optimizer_kwargs: what it was made with, without the learning rate
    :param kernels: weights to decay
    :param weight_decay: coupled L2 coefficient (added to the gradient); 0 leaves the groups alone
    """
    kwargs = dict(optimizer_kwargs)
    if type(optimizer) in FUSED_BY_DEFAULT and not kwargs.keys() & {
        "fused",
        "foreach",
        "capturable",
        "differentiable",
    }:
        kwargs["fused"] = True
    if kwargs == dict(optimizer_kwargs) and not weight_decay:
        return optimizer
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    groups: list[dict[str, Any]] = [{"params": parameters}]
    if weight_decay:
        decayed = {id(kernel) for kernel in kernels}
        groups = [
            {"params": [p for p in parameters if id(p) not in decayed]},
            {"params": [p for p in parameters if id(p) in decayed], "weight_decay": weight_decay},
        ]
        groups = [group for group in groups if group["params"]]
    optimizer_class: Any = type(optimizer)
    rebuilt: th.optim.Optimizer = optimizer_class(groups, lr=optimizer.defaults["lr"], **kwargs)
    return rebuilt
