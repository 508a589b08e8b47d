"""Optimizers whose steps programs take."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from torch.optim import optimizer as torch_optimizer

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.native.library import bits_of

Settings = Callable[[dict[str, Any]], "list[int] | None"]


class Known(NamedTuple):
    """An optimizer that programs know.

    :param settings: ``group_t`` of ``fused.h`` of a parameter group; None for settings that they do
        not know
    :param moments: names of what it remembers, the first and the second; "" where it has none
    """

    settings: Settings
    moments: tuple[str, str]


def _adam(group: dict[str, Any]) -> list[int] | None:
    numbers = (group["lr"], *group["betas"], group["eps"], group["weight_decay"])
    plain = not any(group[name] for name in ("amsgrad", "maximize", "capturable", "differentiable"))
    if not plain or any(isinstance(number, th.Tensor) for number in numbers):
        return None
    return [0, *map(bits_of, map(float, numbers)), int(group["decoupled_weight_decay"])]


KNOWN: dict[type[th.optim.Optimizer], Known] = {
    th.optim.Adam: Known(_adam, ("exp_avg", "exp_avg_sq")),
    th.optim.AdamW: Known(_adam, ("exp_avg", "exp_avg_sq")),
}


def settings_of(optimizer: th.optim.Optimizer, controller: Controller) -> list[list[int]] | None:
    """``group_t`` of each parameter group; None if torch must take the optimizer's steps itself.

    So it must if the kernels do not know it, or somebody wants to see its steps.
    """
    known = KNOWN.get(type(optimizer))
    if known is None or "step" in vars(optimizer) or _watched(optimizer, controller):
        return None
    groups = [known.settings(group) for group in optimizer.param_groups]
    return None if None in groups else groups  # type: ignore[return-value]


def _watched(optimizer: Any, controller: Controller) -> bool:
    """Whether there are hooks on its steps besides those of the controller."""
    own = (*optimizer._optimizer_step_pre_hooks.values(),
           *optimizer._optimizer_step_post_hooks.values())  # fmt: skip
    every: Any = torch_optimizer
    everywhere = (*every._global_optimizer_pre_hooks.values(),
                  *every._global_optimizer_post_hooks.values())  # fmt: skip
    return any(getattr(hook, "__self__", None) is not controller for hook in own) or any(
        not hook.__module__.startswith("sb3_sparse.") for hook in everywhere
    )


def moments_of(
    optimizer: th.optim.Optimizer, tensor: th.Tensor
) -> tuple[th.Tensor | None, th.Tensor, th.Tensor | None] | None:
    """First moment, second moment and counter; None as long as there are none.

    A counter that is no tensor is None.
    """
    state = optimizer.state.get(tensor)
    if not state:
        return None
    first, second = KNOWN[type(optimizer)].moments
    steps = state["step"]
    return (
        state[first] if first else None,
        state[second],
        steps if isinstance(steps, th.Tensor) else None,
    )
