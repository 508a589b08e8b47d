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
    optimizer: th.optim.Optimizer, optimizer_kwargs: Mapping[str, Any]
) -> th.optim.Optimizer:
    """The same optimizer, before its first step, fused where that is a good default.

    Adam is fused unless the user chose ``fused``, ``foreach``, ``capturable`` or
    ``differentiable``: eager Adam takes square roots of second moments, which are slow on the exact
    zeros of a masked weight. Any other optimizer stays as it is.

    :param optimizer_kwargs: what it was made with, without the learning rate
    """
    chosen = {"fused", "foreach", "capturable", "differentiable"}
    if type(optimizer) not in FUSED_BY_DEFAULT or chosen & optimizer_kwargs.keys():
        return optimizer
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    optimizer_class: Any = type(optimizer)
    rebuilt: th.optim.Optimizer = optimizer_class(
        parameters, lr=optimizer.defaults["lr"], **optimizer_kwargs, fused=True
    )
    return rebuilt


def keep_implementation(
    optimizer: th.optim.Optimizer, state_dict: dict[str, Any]
) -> dict[str, Any]:
    """Pre-load hook: a state saved by an eager optimizer does not turn a fused one eager."""
    if "fused" not in optimizer.defaults:
        return state_dict
    fused = optimizer.defaults["fused"]
    groups = [{**group, "fused": fused} for group in state_dict["param_groups"]]
    return {**state_dict, "param_groups": groups}


def add_weight_decay(kernels: Iterable[th.Tensor], weight_decay: float) -> None:
    """Coupled L2: add ``weight_decay * weight`` to the gradient of every kernel that has one.

    Before the step and after any clipping, as optimizers with a ``weight_decay`` of their own do
    it, but for kernels only and whatever the optimizer.
    """
    with th.no_grad():
        for kernel in kernels:
            if kernel.grad is not None:
                kernel.grad.add_(kernel, alpha=weight_decay)
