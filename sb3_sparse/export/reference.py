"""The outputs of a model itself, by SB3's own modules, with which exports are compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BaseModel
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sparse.export.compiler import Compiled
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.inexact import adopted, inexact_quantizations
from sb3_sparse.export.integers import Quantize
from sb3_sparse.export.observations import Observations, count_of
from sb3_sparse.export.parity import TOLERANCE, Actor
from sb3_sparse.policies.registry import sparse_counterpart


def predictor(
    model: BaseAlgorithm,
    normalization: VecNormalize | None,
    further: Sequence[str] = (),
    policy: Any = None,
) -> Actor:
    """Return a function that normalises observations and calls the model's ``predict``.

    :param further: names of further outputs, which stand beside the actions
    :param policy: SB3's policy that computes these; of a model of SBX, the one made of it
    """

    def run(observations: Observations) -> NDArray[Any]:
        seen = observations
        if normalization is not None:
            seen = normalization.normalize_obs(observations)
        actions, _ = model.predict(seen, deterministic=True)
        rows = [np.asarray(actions)]
        if further:
            found = _further(policy, seen, further)
            rows += [found[name].detach().cpu().numpy() for name in further]
        return np.concatenate([np.reshape(r, (count_of(observations), -1)) for r in rows], axis=1)

    return run


def rounded(graph: Graph, exported: Actor) -> Actor:
    """Return a function that runs a policy with rounded weights or whole numbers.

    Where ``exported`` made whole numbers of floats that may differ in their last bits, its numbers
    are taken if the floats differ by no more than an action may, relative to their unit's range.

    :param exported: the same policy, compiled
    """
    places = inexact_quantizations(graph)
    if not places:
        return graph.run
    assert isinstance(exported, Compiled)
    ends = np.cumsum([int(np.prod(graph.shape_of(value))) for value in places])[:-1]

    def run(observations: Observations) -> NDArray[Any]:
        _, numbers = exported.outputs_and_numbers(observations)
        others = dict(zip(places, np.split(numbers.T, ends), strict=True))
        values: list[NDArray[Any]] = [np.moveaxis(graph.rows(observations), 0, -1)]
        for value, node in enumerate(graph.nodes, start=1):
            taken = [values[i] for i in node.inputs]
            if value in others:
                assert isinstance(node, Quantize)
                values.append(adopted(node, taken[0], others[value], TOLERANCE))
            else:
                values.append(node.run(*taken))
        return graph.side_by_side(values)

    return run


def _further(policy: Any, seen: Observations, names: Sequence[str]) -> dict[str, th.Tensor]:
    """Return outputs of a policy by their names."""
    tensor, _ = policy.obs_to_tensor(seen)
    found = {}
    with th.no_grad():
        if "value" in names:
            found["value"] = _value(policy, tensor)
        if "mean" in names:
            gaussian = _gaussian(policy, tensor)
            found |= {"mean": gaussian.mean, "std": gaussian.stddev}
        if "logits" in names:
            features = BaseModel.extract_features(policy, tensor, policy.pi_features_extractor)
            found["logits"] = policy.action_net(policy.mlp_extractor.forward_actor(features))
    return found


def _value(policy: Any, seen: Any) -> th.Tensor:
    declared = sparse_counterpart(policy)
    assert declared is not None
    if declared.estimate == "output":
        values: th.Tensor = policy.predict_values(seen)
        return values
    actions = policy(seen, deterministic=True)
    if declared.estimate == "largest":
        network = getattr(policy, declared.acting[0].partition(".")[0])
        scores = network(seen)
        if declared.acting_quantiles:
            scores = scores.mean(dim=1)
        chosen: th.Tensor = scores.gather(1, actions.reshape(-1, 1))
        return chosen
    estimates = policy.critic(seen, actions)
    if declared.estimate == "mean":
        mean: th.Tensor = estimates.mean(dim=2).mean(dim=1)
        return mean
    return th.cat(estimates, dim=1).min(dim=1).values


def _gaussian(policy: Any, seen: Any) -> Any:
    if isinstance(policy, ActorCriticPolicy):
        return policy.get_distribution(seen).distribution
    mean, log_std, others = policy.actor.get_action_dist_params(seen)
    return policy.actor.action_dist.proba_distribution(mean, log_std, **others).distribution
