"""Translates the distribution that a policy samples its actions from."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
    StateDependentNoiseDistribution,
)
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN
from torch import nn

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.graph import Output
from sb3_sparse.export.nodes import Activation, Linear, Multiply
from sb3_sparse.export.output_nodes import Constant
from sb3_sparse.export.traced_policy import TracedPolicy, module_of

GAUSSIAN = (DiagGaussianDistribution, StateDependentNoiseDistribution)
WITH_LOGITS = (CategoricalDistribution, MultiCategoricalDistribution, BernoulliDistribution)


def distribution_outputs(traced: TracedPolicy, shape: tuple[int, ...]) -> tuple[Output, ...]:
    """Return the outputs ``mean`` and ``std``, or ``logits``.

    :param shape: shape of an action
    :raises UnsupportedError: if the policy has no distribution, or one that is not known
    """
    owner = owner_of(traced.policy, traced.declared.acting)
    distribution = getattr(owner, "action_dist", None)
    if isinstance(distribution, WITH_LOGITS):
        logits = traced.tracer.shape_of(traced.result)
        return (Output("logits", traced.result, logits, _meaning(distribution)),)
    if isinstance(distribution, GAUSSIAN):
        std = _std(traced, owner, distribution)
        where = ", before the tanh" if traced.squashed != traced.result else ""
        return (
            Output("mean", traced.result, shape, f"the mean of the Gaussian{where}"),
            Output("std", std, shape, f"the standard deviation of the Gaussian{where}"),
        )
    if distribution is None:
        raise UnsupportedError(
            f"{type(traced.policy).__name__} has no distribution of actions: what it explores with "
            "is no part of the policy. Leave out stochastic (--stochastic), which is for PPO, "
            "A2C, TRPO, SAC, TQC and CrossQ"
        )
    raise UnsupportedError(
        f"{type(distribution).__name__} cannot be exported; allowed are SB3's Gaussian, "
        "categorical and Bernoulli distributions. Leave out stochastic (--stochastic)"
    )


def owner_of(policy: Any, acting: tuple[str, ...]) -> Any:
    """Return the module that has the distribution: an actor, or the policy.

    :param acting: names of the acting modules
    """
    return module_of(policy, acting[-1].rpartition(".")[0])


def _meaning(distribution: Any) -> str:
    if isinstance(distribution, BernoulliDistribution):
        return "the logits of the probabilities of 1"
    if isinstance(distribution, CategoricalDistribution):
        return "the logits of the choices, for a softmax"
    sizes = ", ".join(map(str, distribution.action_dims))
    return f"the logits of the choices, for a softmax each of {sizes}"


def _std(traced: TracedPolicy, owner: Any, distribution: Any) -> int:
    """Append the operations that compute the standard deviation of each action."""
    tracer, log_std = traced.tracer, owner.log_std
    units = tracer.shape_of(traced.result)
    if isinstance(distribution, StateDependentNoiseDistribution):
        # The sum of the features, each with its own Gaussian factor. Source: arXiv:2005.05719.
        with th.no_grad():
            variances = distribution.get_std(log_std).double().square().T
        weight = variances.expand(units[0], -1).cpu().numpy().astype(np.float32)
        square = tracer.add(
            Multiply((traced.latent, traced.latent), tracer.shape_of(traced.latent))
        )
        bias = np.full(units, distribution.epsilon, np.float32)
        variance = tracer.add(Linear((square,), units, weight, bias))
        return tracer.add(Activation((variance,), units, "sqrt"))
    if isinstance(log_std, nn.Module):
        value = tracer.walk(log_std, traced.latent)
        value = tracer.walk(nn.Hardtanh(float(LOG_STD_MIN), float(LOG_STD_MAX)), value)
        return tracer.add(Activation((value,), units, "exp"))
    numbers = log_std.detach().exp().cpu().numpy().astype(np.float32)
    return tracer.add(Constant((0,), units, numbers.reshape(-1)))
