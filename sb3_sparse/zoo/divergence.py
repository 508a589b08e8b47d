"""Whether a training still computes with numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import Diverged
from sb3_sparse.policies.compiled import unwrapped

CURE = (
    "train anew with a smaller learning_rate, or a smaller max_grad_norm where the algorithm has "
    "one, and see that the environment's observations and rewards are finite"
)
SHOWN = 3


def check_networks(model: BaseAlgorithm) -> None:
    """Refuse to go on with networks that hold NaN or infinity.

    Looks at parameters and buffers of the whole policy, targets included, and at the algorithm's
    own (the entropy coefficient).

    :raises Diverged: with the step, the first names, and what to do
    """
    broken = [name for name, tensor in _tensors(model) if not bool(th.isfinite(tensor).all())]
    if broken:
        names = ", ".join(broken[:SHOWN])
        more = f" and {len(broken) - SHOWN} more" if len(broken) > SHOWN else ""
        raise Diverged(
            f"training diverged: at step {model.num_timesteps} there is NaN or infinity in {names}"
            f"{more}; {CURE}"
        )


def check_return(mean_return: float, step: int) -> None:
    """Refuse to go on after an evaluation whose return is no number.

    :param step: environment steps trained
    :raises Diverged: if so
    """
    if not math.isfinite(mean_return):
        raise Diverged(
            f"training diverged: the evaluation at step {step} has the return {mean_return}, of "
            f"networks that are finite; {CURE}"
        )


def _tensors(model: BaseAlgorithm) -> Iterator[tuple[str, th.Tensor]]:
    policy = unwrapped(model.policy)
    yield from policy.named_parameters()
    for name, buffer in policy.named_buffers():
        if buffer.is_floating_point():
            yield name, buffer
    for name, value in vars(model).items():
        if isinstance(value, th.Tensor) and value.is_floating_point():
            yield name, value
