"""Translates an SB3 model to the graph of its actions and further outputs."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.distribution import distribution_outputs
from sb3_sparse.export.estimate import mean_quantiles, value_output
from sb3_sparse.export.graph import Graph, Output
from sb3_sparse.export.nodes import Affine, Argmax, Clip, Positive
from sb3_sparse.export.preprocess import observed, preprocessed
from sb3_sparse.export.trace import Tracer
from sb3_sparse.export.traced_policy import TracedPolicy, module_of
from sb3_sparse.loading.zips import check_finite
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.registry import sparse_counterpart, supported_algorithms


def graph_of(
    model: BaseAlgorithm,
    normalization: VecNormalize | None,
    with_value: bool = False,
    stochastic: bool = False,
) -> Graph:
    """Return the operations from a raw observation to ``predict(deterministic=True)``.

    :param model: a model of a supported algorithm, with a sparse or stock policy
    :param normalization: what normalises observations before the policy sees them
    :param with_value: whether the estimated return is an output, too
    :param stochastic: whether the parameters of the actions' distribution are
    :raises UnsupportedError: for a network or space that cannot be exported
    """
    policy: Any = unwrapped(model.policy)
    sparse = sparse_counterpart(policy)
    if sparse is None:
        raise UnsupportedError(f"{type(policy).__name__} is not known, so it cannot be exported")
    policy.set_training_mode(False)
    space = model.observation_space
    seen = observed(space)
    tracer = Tracer(seen.shape, {id(module): name for name, module in policy.named_modules()})
    value = preprocessed(tracer, space, normalization, policy.normalize_images)
    extractor, *modules = (module_of(policy, name) for name in sparse.acting)
    features = latent = result = tracer.walk(extractor, value)
    for module in modules:
        latent, result = result, tracer.walk(module, result)
    if sparse.acting_quantiles:
        result = mean_quantiles(tracer, result, attrgetter(sparse.acting_quantiles)(policy))
    squashed = result
    if policy.squash_output and not _ends_in_tanh(modules[-1]):  # but its distribution squashes
        squashed = tracer.walk(nn.Tanh(), result)
    action = _action(tracer, squashed, policy, model.action_space)
    shape = tuple(model.action_space.shape or ())
    traced = TracedPolicy(policy, sparse, tracer, value, features, latent, result, squashed)
    outputs = [Output("action", action, shape)]
    if with_value:
        outputs.append(value_output(traced))
    if stochastic:
        outputs += distribution_outputs(traced, shape)
    chosen = tuple(outputs) if len(outputs) > 1 else ()
    return Graph(seen.shape, tracer.finish(), shape, seen.pixels, seen.parts, chosen)


def _action(tracer: Tracer, result: int, policy: Any, action: spaces.Space[Any]) -> int:
    """Turn the result of the network into an action of the space, as SB3 does."""
    if isinstance(action, spaces.Box):
        return _box(tracer, result, policy, action)
    if isinstance(action, spaces.Discrete):
        return tracer.add(Argmax((result,), (1,), (int(action.n),)))
    if isinstance(action, spaces.MultiDiscrete) and action.nvec.ndim == 1:
        sizes = tuple(int(n) for n in action.nvec)
        return tracer.add(Argmax((result,), (len(sizes),), sizes))
    if isinstance(action, spaces.MultiBinary):
        return tracer.add(Positive((result,), tracer.shape_of(result)))
    raise UnsupportedError(
        f"actions in {action} cannot be exported; allowed are Box, Discrete, MultiDiscrete "
        "(of one axis) and MultiBinary"
    )


def check_model(model: BaseAlgorithm) -> None:
    """Reject a model that cannot be exported correctly.

    :raises UnsupportedError: for an algorithm that is not supported, or weights that are not
        float32
    :raises Diverged: if a weight is not finite
    """
    supported = supported_algorithms()
    if not isinstance(model, tuple(supported.values())):
        raise UnsupportedError(
            f"a model of {type(model).__name__} cannot be exported; supported are "
            f"{', '.join(supported)}"
        )
    policy = unwrapped(model.policy)
    check_finite(policy.state_dict(), "the model")
    for name, parameter in policy.named_parameters():
        if parameter.dtype != th.float32:
            raise UnsupportedError(
                f"{name} is of {parameter.dtype}, and SB3 gives a policy float32 only: "
                "model.predict fails, too. Call policy.float() before the export"
            )


def _ends_in_tanh(module: nn.Module) -> bool:
    return isinstance([*module.modules()][-1], nn.Tanh)


def _box(tracer: Tracer, value: int, policy: Any, space: spaces.Box) -> int:
    """Clip or rescale the network's output to the action's bounds, as SB3 does."""
    low = space.low.reshape(-1).astype(np.float32)
    high = space.high.reshape(-1).astype(np.float32)
    shape = tracer.shape_of(value)
    if policy.squash_output:
        scale = (0.5 * (high.astype(np.float64) - low)).astype(np.float32)
        if (scale != 1).any() or (low != -1).any():
            value = tracer.add(Affine((value,), shape, scale, low + scale))
        return value
    return tracer.add(Clip((value,), shape, low, high))


def span_of(model: BaseAlgorithm) -> NDArray[np.float64]:
    """Return half the range that each action is squashed into, shape ``(actions,)``; else 0."""
    space = model.action_space
    if not (isinstance(space, spaces.Box) and unwrapped(model.policy).squash_output):
        return np.zeros(1)
    return (space.high.reshape(-1).astype(np.float64) - space.low.reshape(-1)) / 2.0
