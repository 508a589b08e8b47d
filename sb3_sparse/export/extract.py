"""Translates an SB3 model to the graph of its deterministic actions."""

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
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Affine, Argmax, Clip, Linear, Positive
from sb3_sparse.export.preprocess import observed, preprocessed
from sb3_sparse.export.trace import Tracer
from sb3_sparse.loading.zips import check_finite
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.registry import sparse_counterpart, supported_algorithms


def graph_of(model: BaseAlgorithm, normalization: VecNormalize | None) -> Graph:
    """Return the operations from a raw observation to ``predict(deterministic=True)``.

    :param model: a model of a supported algorithm, with a sparse or stock policy
    :param normalization: what normalises observations before the policy sees them
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
    try:
        extractor, *modules = map(policy.get_submodule, sparse.acting)
    except AttributeError as error:
        raise UnsupportedError(
            f"{type(policy).__name__} is not built as SB3's own policies are ({error}), so it "
            "cannot be exported"
        ) from error
    if policy.squash_output and not _ends_in_tanh(modules[-1]):  # but its distribution squashes
        modules.append(nn.Tanh())
    result = tracer.walk(extractor, value)
    for module in modules:
        result = tracer.walk(module, result)
    action = model.action_space
    if sparse.acting_quantiles:
        quantiles = attrgetter(sparse.acting_quantiles)(policy)
        result = _mean_quantiles(tracer, result, quantiles)
    if isinstance(action, spaces.Box):
        _box(tracer, result, policy, action)
    elif isinstance(action, spaces.Discrete):
        tracer.add(Argmax((result,), (1,), (int(action.n),)))
    elif isinstance(action, spaces.MultiDiscrete) and action.nvec.ndim == 1:
        sizes = tuple(int(n) for n in action.nvec)
        tracer.add(Argmax((result,), (len(sizes),), sizes))
    elif isinstance(action, spaces.MultiBinary):
        tracer.add(Positive((result,), tracer.shape_of(result)))
    else:
        raise UnsupportedError(
            f"actions in {action} cannot be exported; allowed are Box, Discrete, MultiDiscrete "
            "(of one axis) and MultiBinary"
        )
    shape = action.shape or ()
    return Graph(seen.shape, tracer.finish(), tuple(shape), seen.pixels, seen.parts)


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


def _mean_quantiles(tracer: Tracer, value: int, quantiles: int) -> int:
    """Let the last layer compute the mean over quantiles, by which QR-DQN acts."""
    last = tracer.nodes[value - 1]
    if not isinstance(last, Linear):
        raise UnsupportedError("a quantile network that does not end in a Linear layer")
    actions = len(last.weight) // quantiles
    weight = last.weight.astype(np.float64).reshape(quantiles, actions, -1).mean(axis=0)
    bias = last.bias.astype(np.float64).reshape(quantiles, actions).mean(axis=0)
    tracer.nodes[value - 1] = Linear(
        last.inputs, (actions,), weight.astype(np.float32), bias.astype(np.float32)
    )
    return value


def _box(tracer: Tracer, value: int, policy: Any, space: spaces.Box) -> None:
    """Clip or rescale the network's output to the action's bounds, as SB3 does."""
    low = space.low.reshape(-1).astype(np.float32)
    high = space.high.reshape(-1).astype(np.float32)
    shape = tracer.shape_of(value)
    if policy.squash_output:
        scale = (0.5 * (high.astype(np.float64) - low)).astype(np.float32)
        if (scale != 1).any() or (low != -1).any():
            tracer.add(Affine((value,), shape, scale, low + scale))
    else:
        tracer.add(Clip((value,), shape, low, high))


def span_of(model: BaseAlgorithm) -> NDArray[np.float64]:
    """Return half the range that each action is squashed into, shape ``(actions,)``; else 0."""
    space = model.action_space
    if not (isinstance(space, spaces.Box) and unwrapped(model.policy).squash_output):
        return np.zeros(1)
    return (space.high.reshape(-1).astype(np.float64) - space.low.reshape(-1)) / 2.0
