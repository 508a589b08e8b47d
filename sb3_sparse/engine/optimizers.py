"""Optimizer settings for masked training."""

from __future__ import annotations

import copy
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch as th
from torch import nn

from sb3_sparse.engine.internals import STEP_HOOKS
from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.numeric import is_number

FUSED_BY_DEFAULT = (th.optim.Adam, th.optim.AdamW)


def check_weight_decay(weight_decay: float, optimizer_kwargs: Mapping[str, Any] | None) -> float:
    """Validate ``weight_decay`` and return it as a float.

    :raises ConfigError: if it is negative, not a number, or given to the optimizer as well
    """
    if not is_number(weight_decay):
        raise ConfigError(f"weight_decay must be a number, 0 or more, got {weight_decay!r}")
    if not 0.0 <= weight_decay < float("inf"):
        raise ConfigError(f"weight_decay must be 0 or more, got {weight_decay}")
    if weight_decay and (optimizer_kwargs or {}).get("weight_decay"):
        raise ConfigError(
            "weight_decay is given twice: as a policy argument (weights only) and in "
            "optimizer_kwargs (all parameters); keep one"
        )
    return float(weight_decay)


def prefer_fused(optimizer: th.optim.Optimizer) -> None:
    """Select torch's fused implementation of Adam before its first step, and change nothing else.

    Eager Adam takes square roots of second moments, which are slow on the exact zeros of a masked
    weight. Groups whose ``fused``, ``foreach``, ``capturable`` or ``differentiable`` the user has
    set stay unchanged, as do other optimizers.
    """
    if type(optimizer) not in FUSED_BY_DEFAULT or optimizer.state:
        return
    for settings in (optimizer.defaults, *optimizer.param_groups):
        chosen = settings["fused"] is not None or settings["foreach"] is not None
        if not (chosen or settings["capturable"] or settings["differentiable"]):
            settings["fused"] = True


def acts_elementwise(optimizer: th.optim.Optimizer) -> bool:
    """Whether the optimizer moves active weights alike with and without inactive ones.

    It is found by trial: a copy takes three steps on a 4x6 matrix with zeros, and on its other
    entries as a vector. Adam, SGD and RMSprop pass. Adafactor and Muon, whose steps depend on rows
    and columns, optimizers that add noise and those that fail on such weights do not.
    """
    active = th.arange(24).view(4, 6) % 3 > 0
    start = th.linspace(-1.0, 1.0, 24).view(4, 6) * active
    try:
        with th.random.fork_rng(devices=[]):
            th.default_generator.manual_seed(0)
            matrix, memory = _trial(optimizer, start, lambda step: (start + step).sin() * active)
            th.default_generator.manual_seed(0)
            vector, _ = _trial(optimizer, start[active], lambda step: (start[active] + step).sin())
    except Exception:  # for any reason: it does not take a weight as a plain vector
        return False
    return (
        th.allclose(matrix[active], vector, rtol=1e-4, atol=1e-7)
        and not matrix[~active].any()
        and all(value.shape == start.shape for value in memory)
    )


def _trial(
    optimizer: th.optim.Optimizer, start: th.Tensor, grad: Callable[[int], th.Tensor]
) -> tuple[th.Tensor, list[th.Tensor]]:
    """Take three steps with a copy of the optimizer; return the parameter and its moments."""
    parameter = nn.Parameter(start.clone())
    copied = copy.copy(optimizer)
    copied.state = defaultdict(dict)
    group = {**optimizer.param_groups[0], "params": [parameter], "lr": 0.01}
    copied.param_groups = [group]
    for hooks in STEP_HOOKS:
        setattr(copied, hooks, OrderedDict())
    for step in range(3):
        parameter.grad = grad(step)
        copied.step()
    values = copied.state[parameter].values()
    return parameter.detach(), [v for v in values if isinstance(v, th.Tensor) and v.dim()]


def keep_implementation(
    optimizer: th.optim.Optimizer, state_dict: dict[str, Any]
) -> dict[str, Any]:
    """Pre-load hook: keep a fused optimizer fused when the saved one was not."""
    if "fused" not in optimizer.defaults:
        return state_dict
    fused = optimizer.defaults["fused"]
    groups = [{**group, "fused": fused} for group in state_dict["param_groups"]]
    return {**state_dict, "param_groups": groups}


def add_weight_decay(weights: Iterable[th.Tensor], weight_decay: float) -> None:
    """Coupled L2: add ``weight_decay * weight`` to the gradient of every weight that has one.

    It applies before the step and after clipping, like the ``weight_decay`` of torch's optimizers,
    but to weights only and with every optimizer.
    """
    with th.no_grad():
        for tensor in weights:
            if tensor.grad is not None:
                tensor.grad.add_(tensor, alpha=weight_decay)
