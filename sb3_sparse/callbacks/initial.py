"""The weights that a policy might have started with."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import chain
from typing import Any

import torch as th
from torch import nn

from sb3_sparse.analysis.batches import own_randomness
from sb3_sparse.engine.layer import MASK_KEY
from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import plain_names, unwrapped
from sb3_sparse.sparsity.initialisation import sparsity_aware_weights

DENSE = {
    "sparsity": 0.0,
    "initial_sparsity": None,
    "actor_share": None,
    "sparsity_aware_init": False,
    "weight_decay": 0.0,
    "mask_seed": 0,
    "compute": "masked",
}
"""Arguments of a policy that only SB3 initialises."""


def initial_state(policy: BaseSparsePolicy, step: int) -> dict[str, th.Tensor]:
    """Draw initial values of all parameters and buffers of a policy, by name; weights are dense.

    Names are those without ``torch.compile``, and masks are left out.

    They are SB3's. Layers of networks that started sparse, with ``sparsity_aware_init``, are drawn
    by their active fans, as at the start, but with the present masks, and are 0 where inactive. The
    same policy and step give the same values, and no global generator advances.

    :param policy: the policy; it does not change
    :param step: gradient step, which addresses the draw
    """
    seed = policy.sparse.seed
    address = hashlib.sha256(f"initial parameters {seed} {step}".encode()).digest()
    arguments: dict[str, Any] = {**policy._get_constructor_parameters(), **DENSE}
    with own_randomness(int.from_bytes(address[:4], "little"), policy.device):
        fresh = type(policy)(**arguments)
    found = {name: tensor.detach().to(policy.device) for name, tensor in tensors_by_name(fresh)}
    if not policy.sparsity_config.sparsity_aware_init:
        return found
    for network in policy.sparse.networks:
        if any(layer.initial_nnz < layer.size for layer in network.layers):
            for layer in network.layers:
                mask, gain = layer.mask().reshape(layer.shape), policy._initial_gain(layer.name)
                weights = sparsity_aware_weights(mask, seed, layer.name, gain, step)
                found[f"{layer.name}.weight"] = th.from_numpy(weights).to(policy.device)
    return found


def tensors_by_name(policy: nn.Module) -> Iterator[tuple[str, th.Tensor]]:
    """Yield parameters and buffers but masks, by their names without ``torch.compile``."""
    tensors = dict(chain(policy.named_parameters(), policy.named_buffers()))
    for name, tensor in plain_names(tensors).items():
        if not name.rpartition(".")[2].startswith(MASK_KEY):
            yield name, tensor


def sparse_policy_of(model: Any, callback: object) -> BaseSparsePolicy:
    """Return a model's policy.

    :param callback: who needs it, for the message
    :raises ConfigError: if it is not sparse
    """
    policy = unwrapped(model.policy)
    if not isinstance(policy, BaseSparsePolicy):
        raise ConfigError(
            f"{type(callback).__name__} needs a sparse policy (with sparsity=0.0 for dense "
            f"training), got {type(policy).__name__}; make the model with SparsePolicy"
        )
    return policy
