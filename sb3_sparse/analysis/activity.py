"""Dormant units, and the effective rank of the last features."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import nn

from sb3_sparse.analysis.networks import dense_twin, modules_of, prunable_of, specs_of
from sb3_sparse.engine.internals import pytree
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.spec import output_layers

CHUNK = 128
"""Observations in one forward pass."""


@dataclass(frozen=True)
class DormantShare:
    """Fractions of dormant units.

    Example::

        from sb3_sparse import DQN
        from sb3_sparse.analysis import dormant_share

        model = DQN("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
        observations = model.get_env().reset()
        print(dormant_share(model, observations).networks["q_net"])

    :param networks: fraction in each network that has activation functions
    :param overall: fraction in all of these together
    """

    networks: dict[str, float]
    overall: float


@dataclass
class Activity:
    """Activations of one network on some observations.

    :param activations: mean absolute activation of every unit, by layer
    :param features: inputs of each output layer, shape ``(observations, dim)``
    :param names: dotted name of the activation function of each of ``activations``
    """

    activations: list[NDArray[np.float64]] = field(default_factory=list)
    features: list[NDArray[np.float64]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def dormant(self, tau: float) -> NDArray[np.bool_]:
        """Whether each unit is ``tau``-dormant, for all layers together."""
        found = [units <= tau * units.mean() for units in self.activations]
        return np.concatenate(found)


def dormant_share(
    model: BaseAlgorithm | BasePolicy, observations: Any, tau: float = 0.025, actions: Any = None
) -> DormantShare:
    """Share of units that are ``tau``-dormant: mean ``|activation| / layer's mean <= tau``.

    A layer is the output of a module of ``torch.nn.modules.activation``, and a unit is one of its
    features (a channel, for images). If all activations of a layer are 0, its units are dormant.

    :param model: an SB3 model or its policy, sparse or stock; it does not change
    :param observations: a batch, as the policy's ``predict`` takes it, or tensors of a buffer
    :param tau: threshold, 0 or more
    :param actions: for critics of actions, scaled to [-1, 1], shape ``(observations, dim)``; None:
        the actor's deterministic actions
    :raises ConfigError: if no network has such a module, or for a tau below 0

    Source: Sokar et al. 2023 (arXiv:2302.12902), definition 3.1.
    """
    if not tau >= 0:
        raise ConfigError(f"tau must be a number, 0 or more, got {tau!r}")
    return dormant_of(activity(model, observations, actions), tau)


def dormant_of(found: dict[str, Activity], tau: float) -> DormantShare:
    """As :func:`dormant_share`, for activations that are known already."""
    dormant = {name: one.dormant(tau) for name, one in found.items() if one.activations}
    if not dormant:
        raise ConfigError(
            f"none of the networks {', '.join(found)} has an activation function that is a module, "
            "so there are no units that could be dormant"
        )
    overall = np.concatenate(list(dormant.values())).mean()
    return DormantShare({name: float(d.mean()) for name, d in dormant.items()}, float(overall))


def effective_rank(features: Any, delta: float = 0.01) -> int:
    """Least number of singular values that make up ``1 - delta`` of their sum; 0 if it is 0.

    :param features: shape ``(n, dim)``
    :param delta: in [0, 1)
    :raises ConfigError: for another shape or delta

    Source: Kumar et al. 2021 (arXiv:2010.14498), section 3.
    """
    matrix = np.asarray(features, np.float64)
    if matrix.ndim != 2 or not 0 <= delta < 1:
        raise ConfigError(
            "effective_rank takes features of shape (n, dim) and a delta in [0, 1), got "
            f"{matrix.shape} and {delta!r}"
        )
    sums = np.cumsum(np.linalg.svd(matrix, compute_uv=False))
    if not len(sums) or sums[-1] == 0:
        return 0
    rounding = 1e-12
    return int(np.argmax(sums >= (1 - delta - rounding) * sums[-1])) + 1


def effective_ranks(
    model: BaseAlgorithm | BasePolicy, observations: Any, delta: float = 0.01, actions: Any = None
) -> dict[str, float]:
    """:func:`effective_rank` of the inputs of each network's output layer.

    For several heads with features of their own, such as twin critics, it is the mean. It cannot
    exceed the number of observations.

    :param model: an SB3 model or its policy; it does not change
    :param observations: as for :func:`dormant_share`
    :param delta: in [0, 1)
    :param actions: as for :func:`dormant_share`
    :return: rank by network
    """
    return ranks_of(activity(model, observations, actions), delta)


def ranks_of(found: dict[str, Activity], delta: float) -> dict[str, float]:
    """As :func:`effective_ranks`, for activations that are known already."""
    return {
        name: float(np.mean([effective_rank(features, delta) for features in one.features]))
        for name, one in found.items()
    }


def activity(
    model: BaseAlgorithm | BasePolicy, observations: Any, actions: Any = None
) -> dict[str, Activity]:
    """Run every network on observations; shared layers count for the first network.

    :raises ConfigError: without observations, or if actions do not fit them
    """
    model = unwrapped(model)
    policy = model if isinstance(model, BasePolicy) else unwrapped(model.policy)
    twin = dense_twin(policy)
    tensors = tensors_of(twin, observations)
    count = len(pytree.tree_leaves(tensors)[0])
    if actions is not None:
        actions = th.as_tensor(actions, dtype=th.float32, device=policy.device)
    if count == 0 or (actions is not None and len(actions) != count):
        given = "none" if actions is None else len(actions)
        raise ConfigError(f"got {count} observations and {given} actions")
    seen: set[int] = set()
    found = {}
    for network, spec in specs_of(twin).items():
        modules = {n: m for n, m in modules_of(twin, spec).items() if id(m) not in seen}
        seen.update(map(id, modules.values()))
        heads = output_layers(spec, list(prunable_of(twin, spec)))
        watched = _Watched(
            {name: m for name, m in modules.items() if is_activation(m)},
            [twin.get_submodule(name) for name in sorted(heads)],
        )
        with th.no_grad():
            for part in _parts(tensors, actions, count):
                run_network(twin, network, *part)
                watched.end_part()
        found[network] = watched.remove(count)
    return found


def is_activation(module: nn.Module) -> bool:
    """Whether a module is an activation function, whose results are units."""
    return type(module).__module__ == "torch.nn.modules.activation"


def tensors_of(policy: BasePolicy, observations: Any) -> Any:
    """Observations as tensors, from any form that :func:`activity` takes."""
    leaves = pytree.tree_leaves(observations)
    if leaves and all(isinstance(leaf, th.Tensor) for leaf in leaves):
        return pytree.tree_map(lambda leaf: leaf.to(policy.device), observations)
    return policy.obs_to_tensor(observations)[0]


def _parts(tensors: Any, actions: Any, count: int) -> Iterator[tuple[Any, Any]]:
    for start in range(0, count, CHUNK):
        here = slice(start, start + CHUNK)
        observations = pytree.tree_map(lambda leaf, here=here: leaf[here], tensors)
        yield observations, None if actions is None else actions[here]


def run_network(policy: Any, network: str, observations: Any, actions: Any) -> None:
    """Run one network of a policy.

    :param observations: tensors
    :param actions: for critics of actions; None: the actor's
    """
    if isinstance(policy, ActorCriticPolicy):
        if network == "actor":
            policy.get_distribution(observations)
        else:
            policy.predict_values(observations)
    elif network == "actor":
        policy.actor._predict(observations, deterministic=True)
    elif network == "critic":
        if actions is None:
            actions = policy.actor._predict(observations, deterministic=True)
        policy.critic(observations, actions)
    else:
        policy.get_submodule(network)(observations)


class _Watched:
    """Hooks that sum up a twin's activations during the passes of one network.

    :param activations: activation functions by name
    :param heads: output layers
    """

    def __init__(self, activations: dict[str, nn.Module], heads: list[nn.Module]) -> None:
        self.sums: list[th.Tensor] = []
        self.features: list[list[th.Tensor]] = []
        self.part: list[th.Tensor] = []
        self.inputs: list[th.Tensor] = []
        self.called: list[str] = []
        self.handles = [
            module.register_forward_hook(partial(self._activated, name))
            for name, module in activations.items()
        ]
        self.handles += [m.register_forward_pre_hook(self._entered) for m in heads]

    def _activated(self, name: str, module: nn.Module, inputs: Any, output: th.Tensor) -> None:
        self.called.append(name)
        size = output.abs().double().flatten(2) if output.dim() > 2 else output.abs().double()
        self.part.append((size.mean(dim=2) if size.dim() > 2 else size).sum(dim=0))

    def _entered(self, module: nn.Module, inputs: tuple[th.Tensor, ...]) -> None:
        if not any(inputs[0] is other for other in self.inputs):  # heads that share features
            self.inputs.append(inputs[0])

    def end_part(self) -> None:
        """Add the sums of one chunk of observations."""
        if not self.sums:
            self.sums = [th.zeros_like(part) for part in self.part]
        self.sums = [a + b for a, b in zip(self.sums, self.part, strict=True)]
        self.features.append([x.flatten(1).double().cpu() for x in self.inputs])
        self.part, self.inputs = [], []

    def remove(self, count: int) -> Activity:
        """Remove the hooks, and return the means over observations."""
        for handle in self.handles:
            handle.remove()
        features = [th.cat(parts).numpy() for parts in zip(*self.features, strict=True)]
        means = [(total / count).cpu().numpy() for total in self.sums]
        return Activity(means, features, self.called[: len(means)])
