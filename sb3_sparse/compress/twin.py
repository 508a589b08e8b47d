"""Makes sparse twins of trained models."""

from __future__ import annotations

import copy
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import save_to_zip_file

from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.errors import ConfigError, UnsupportedError
from sb3_sparse.loading.zips import check_finite
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.internals import has_own_logger, no_schedule
from sb3_sparse.policies.registry import supported_algorithms
from sb3_sparse.policies.saving import load_without_buffer, parts_of
from sb3_sparse.sparsity.selection import largest

Algorithm = TypeVar("Algorithm", bound=BaseAlgorithm)
StateDict = dict[str, th.Tensor]

MASK = ".weight_mask"


def sparsify(
    model: Algorithm,
    sparsity: float | Mapping[str, float],
    *,
    distribution: str | None = None,
    dense_layers: Sequence[str] | None = None,
    compute: str | None = None,
) -> Algorithm:
    """Return a sparse twin of a trained model, which may be dense or sparse and is not changed.

    Every layer keeps the weights of largest magnitude, so the twin acts as the model would with all
    other weights set to 0. It has the same algorithm, hyperparameters, step count and optimizer
    states (0 where a connection is gone), and continues training where the model would. It shares
    the model's environment and replay buffer, so train only one of the two. Like ``load``, this
    seeds the random generators if the model has a ``seed``.

    A model that is sparse already can only lose connections.

    :param model: a model of a supported algorithm, with one of SB3's own policies or a sparse one
    :param sparsity: removed fraction of the weights, in [0, 1), or one for each
        network, e.g. ``{"actor": 0.9, "critic": 0.0}``
    :param distribution: ``"erk"``, ``"er"`` or ``"uniform"``; None: a sparse model's own, else
        ``"erk"``
    :param dense_layers: layers left dense; None: a sparse model's own, else none
    :param compute: as of :class:`~sb3_sparse.policies.base.BaseSparsePolicy`; None: a sparse
        model's own, else ``"auto"``
    :raises ConfigError: for a value that is not allowed, or if a layer would need more connections
        than it has
    :raises UnsupportedError: for another algorithm or a policy class that has no sparse counterpart
    :raises Diverged: if the model's network is not finite

    Source: magnitude pruning, arXiv:1506.02626; distributions, arXiv:1911.11134, section 3.
    """
    policy_class = _sparse_class(model)
    data, params, variables = parts_of(model)
    check_finite(params["policy"], "the model")
    given = {"distribution": distribution, "dense_layers": dense_layers, "compute": compute}
    data["policy_class"] = policy_class
    data["policy_kwargs"] = {
        "mask_seed": model.seed or 0,  # not drawn, so that equal calls give equal twins
        **data["policy_kwargs"],
        "sparsity": dict(sparsity) if isinstance(sparsity, Mapping) else sparsity,
        "initial_sparsity": None,
        "actor_share": None,
        **{key: value for key, value in given.items() if value is not None},
    }
    params["policy"] = _pruned(model, data, params["policy"])
    twin_file = io.BytesIO()
    save_to_zip_file(twin_file, data=data, params=params, pytorch_variables=variables)
    twin_file.seek(0)
    twin = load_beside(model, twin_file, force_reset=False)
    if has_own_logger(model):
        twin.set_logger(model.logger)
    policy = sparse_policy(twin)
    for layer in policy.sparse.layers:
        layer.settle_moments(policy.sparse.optimizers)
    return twin


def load_beside(
    model: Algorithm, file: io.BufferedIOBase | Path, force_reset: bool = True
) -> Algorithm:
    """Load a model that shares the environment and replay buffer of another.

    :param force_reset: whether the environment is reset before the model trains
    """
    loaded = load_without_buffer(
        type(model), file, env=model.env, device=model.device, force_reset=force_reset
    )
    if isinstance(model, OffPolicyAlgorithm):
        vars(loaded)["replay_buffer"] = model.replay_buffer
    return loaded


def sparse_policy(model: BaseAlgorithm) -> BaseSparsePolicy:
    """Return the policy of a model that is known to be sparse."""
    policy = unwrapped(model.policy)
    assert isinstance(policy, BaseSparsePolicy)
    return policy


def sparsity_of(model: BaseAlgorithm) -> dict[str, float]:
    """Return the sparsity of each network as configured; 0 for a dense model.

    :raises UnsupportedError: as :func:`sparsify`
    """
    policy = unwrapped(model.policy)
    if isinstance(policy, BaseSparsePolicy):
        sizes = {network.name: network.size for network in policy.sparse.networks}
        return policy.sparsity_config.by_network(sizes)
    return dict.fromkeys(_sparse_class(model).networks, 0.0)


def magnitude_mask(
    weights: NDArray[np.float32], active: NDArray[np.bool_], count: int
) -> NDArray[np.bool_]:
    """Return a mask of the ``count`` active weights of largest magnitude.

    Ties keep the lowest index.

    :param weights: shape ``(n,)``
    :param active: which weights may stay, shape ``(n,)``
    :param count: at most the number of active weights
    """
    mask = np.zeros(weights.size, dtype=np.bool_)
    mask[largest(np.where(active, np.abs(weights), -1.0), count)] = True
    return mask


def _sparse_class(model: BaseAlgorithm) -> type[BaseSparsePolicy]:
    """Return the sparse counterpart of a model's policy class."""
    supported = supported_algorithms()
    if not isinstance(model, tuple(supported.values())):
        raise UnsupportedError(
            f"{type(model).__name__} has no sparse policy; supported are {', '.join(supported)}"
        )
    own = type(unwrapped(model.policy))
    if issubclass(own, BaseSparsePolicy):
        return own
    aliases = model.policy_aliases
    for name, policy_class in aliases.items():
        if policy_class is own and (found := aliases.get(f"Sparse{name}")) is not None:
            assert issubclass(found, BaseSparsePolicy)
            return found
    names = [name for name in aliases if f"Sparse{name}" in aliases]
    raise UnsupportedError(
        f"the policy {own.__module__}.{own.__qualname__} is not one of SB3's own for "
        f"{type(model).__name__} ({', '.join(names)}) and not sparse. Train with one of these; "
        "custom networks are welcome in policy_kwargs"
    )


def _pruned(model: BaseAlgorithm, data: Mapping[str, Any], saved: StateDict) -> StateDict:
    """Return the state_dict of the twin's policy.

    :param data: the twin's saved attributes
    :param saved: state_dict of the model's policy
    """
    policy = _masked_policy(data)
    for layer in policy.sparse.layers:
        assert isinstance(layer, MaskedStorage)
        layer.set_mask(np.ones(layer.size, dtype=np.bool_))
    weights = {key: value for key, value in saved.items() if not key.endswith(MASK)}
    found = policy.load_state_dict(weights, strict=False)
    missing = [key for key in found.missing_keys if not key.endswith((MASK, "_extra_state"))]
    if missing or found.unexpected_keys:
        raise UnsupportedError(
            f"{type(unwrapped(model.policy)).__name__} has other parameters than "
            f"{type(policy).__name__} with the same policy_kwargs: "
            f"{', '.join([*missing, *found.unexpected_keys])}"
        )
    for layer in policy.sparse.layers:
        assert isinstance(layer, MaskedStorage)
        mask = saved.get(f"{layer.name}{MASK}")
        active = np.ones(layer.size, dtype=np.bool_) if mask is None else mask.numpy().ravel()
        has = int(active.sum())
        if has < layer.final_nnz:
            config = policy.sparsity_config
            raise ConfigError(
                f"sparsity={config.sparsity} ({config.distribution}) asks for {layer.final_nnz} "
                f"connections in {layer.name}, of which {has} are left: a sparse model can only "
                f"lose connections. Its networks have {sparsity_of(model)}; give as much or more, "
                "and leave distribution and dense_layers out"
            )
        layer.set_mask(magnitude_mask(layer.dense(), active, layer.final_nnz))
        layer.mask_targets()
    state: StateDict = policy.state_dict()
    return state


def _masked_policy(data: Mapping[str, Any]) -> BaseSparsePolicy:
    """Make a new policy of the twin's class, on the CPU and with masks."""
    policy_class: type[BaseSparsePolicy] = data["policy_class"]
    kwargs = {**copy.deepcopy(data["policy_kwargs"]), "compute": "masked"}
    if data["use_sde"]:
        kwargs["use_sde"] = True
    with th.random.fork_rng(devices=[]):
        return policy_class(data["observation_space"], data["action_space"], no_schedule, **kwargs)
