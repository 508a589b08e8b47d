"""Checks that networks, distributions of actions and returns are usable during training."""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import Diverged
from sb3_sparse.policies.compiled import unwrapped

CURE = (
    "train anew with a smaller learning_rate, or a smaller max_grad_norm where the algorithm has "
    "one, and check that the environment's observations and rewards are finite"
)
SHOWN = 3
OF_ACTIONS = "stable_baselines3.common.distributions"


def check_networks(model: BaseAlgorithm) -> None:
    """Raise if a network holds NaN or infinity.

    Checks the parameters and buffers of the whole policy, targets included, and the algorithm's
    own tensors (the entropy coefficient).

    :raises Diverged: naming the step, the first broken tensors, and what to do
    """
    broken = [name for name, tensor in _tensors(model) if not bool(th.isfinite(tensor).all())]
    if broken:
        names = ", ".join(broken[:SHOWN])
        more = f" and {len(broken) - SHOWN} more" if len(broken) > SHOWN else ""
        raise Diverged(
            f"training diverged: at step {model.num_timesteps} there is NaN or infinity in {names}"
            f"{more}; {CURE}"
        )


def check_actions(model: BaseAlgorithm, error: Exception) -> None:
    """Raise if an error is torch's refusal to make a distribution of what the policy computes.

    Weights may be finite and yet too large, e.g. a logarithm of -1e30 for a standard deviation. An
    observation that is not finite has the same effect, but is the environment's.

    :raises Diverged: naming the step and what to do
    """
    frames = traceback.walk_tb(error.__traceback__)
    modules = [str(frame.f_globals.get("__name__")) for frame, _ in frames]
    refused = isinstance(error, ValueError) and modules[-1].startswith("torch.distributions.")
    if refused and OF_ACTIONS in modules and _is_finite(model._last_obs):
        raise Diverged(
            f"training diverged: at step {model.num_timesteps} the policy's outputs define no "
            f"distribution of actions, though all networks are finite; {CURE}"
        )


def check_return(mean_return: float, step: int) -> None:
    """Raise if the mean return of an evaluation is not finite.

    :param step: environment steps trained
    :raises Diverged: naming the step, the return, and what to do
    """
    if not math.isfinite(mean_return):
        raise Diverged(
            f"training diverged: the evaluation at step {step} has the return {mean_return}, "
            f"though all networks are finite; {CURE}"
        )


def _is_finite(observations: Any) -> bool:
    parts = observations.values() if isinstance(observations, dict) else [observations]
    return all(part is None or bool(np.isfinite(part).all()) for part in parts)


def _tensors(model: BaseAlgorithm) -> Iterator[tuple[str, th.Tensor]]:
    policy = unwrapped(model.policy)
    yield from policy.named_parameters()
    for name, buffer in policy.named_buffers():
        if buffer.is_floating_point():
            yield name, buffer
    for name, value in vars(model).items():
        if isinstance(value, th.Tensor) and value.is_floating_point():
            yield name, value
