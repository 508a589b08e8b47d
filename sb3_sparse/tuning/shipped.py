"""The shipped spaces: the paper's grid, and a wide continuous space around it."""

from __future__ import annotations

from collections.abc import Mapping

from sb3_sparse.sparsity.budgets import feasible_actor_share
from sb3_sparse.topology import Methods
from sb3_sparse.tuning.backend import BaseDistribution
from sb3_sparse.tuning.spaces import (
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
    Space,
)
from sb3_sparse.zoo.configs import DENSE

WEIGHT_DECAY = (0.0, 1e-6, 1e-4, 1e-3)
UPDATE_INTERVAL = (100, 250, 500, 1000, 5000)
DROP_FRACTION = (0.0, 0.1, 0.2, 0.3, 0.5)
SPARSITY_AWARE_INIT = (True, False)
ACTOR_SHARE = (0.05, 0.6)


def paper_space(method: str) -> Space:
    """Return the paper's grid over the hyperparameters that a method has.

    :param method: ``"dense"``, a topology method, or methods by network as in ``critic=rigl``
    :raises ConfigError: for an unknown method

    Source: arXiv:2206.10369, appendix "Hyper-parameter sweep".
    """
    searched: dict[str, BaseDistribution] = {"weight_decay": CategoricalDistribution(WEIGHT_DECAY)}
    if method == DENSE:
        return Space("paper", searched)
    methods = Methods.parse(method)
    if "update_interval" in methods.options:
        searched["update_interval"] = CategoricalDistribution(UPDATE_INTERVAL)
    if "drop_fraction" in methods.options:
        searched["drop_fraction"] = CategoricalDistribution(DROP_FRACTION)
    if not methods.start_dense:  # a dense start has no sparse initialisation
        searched["sparsity_aware_init"] = CategoricalDistribution(SPARSITY_AWARE_INIT)
    return Space("paper", searched)


def wide_space(method: str, sizes: Mapping[str, int], sparsity: float | None) -> Space:
    """Return a continuous space around the paper's grid, for a method and a policy.

    :param method: ``"dense"``, a topology method, or methods by network as in ``critic=rigl``
    :param sizes: connections of each network of the policy, were it dense, by name
    :param sparsity: sparsity of all networks together; None if each has its own, so that there is
        no common budget to share out
    :raises ConfigError: for an unknown method
    """
    searched: dict[str, BaseDistribution] = {
        "weight_decay": FloatDistribution(1e-7, 1e-2, log=True),
        "learning_rate": FloatDistribution(1e-5, 1e-2, log=True),
    }
    if method == DENSE:
        return Space("wide", searched)
    methods = Methods.parse(method)
    if "update_interval" in methods.options:
        searched["update_interval"] = IntDistribution(50, 10_000, log=True)
    if "drop_fraction" in methods.options:
        searched["drop_fraction"] = FloatDistribution(0.0, 0.5)
    searched["distribution"] = CategoricalDistribution(("erk", "uniform"))
    if sizes.keys() == {"actor", "critic"} and sparsity is not None:
        low, high = feasible_actor_share(*_room(methods, sizes, sparsity))
        low, high = max(low, ACTOR_SHARE[0]), min(high, ACTOR_SHARE[1])
        low, high = round(low + 5e-5, 4), round(high - 5e-5, 4)
        if low < high:
            searched["actor_share"] = FloatDistribution(low, high)
    return Space("wide", searched)


def _room(
    methods: Methods, sizes: Mapping[str, int], sparsity: float
) -> tuple[float, float, float]:
    """Return what the actor and the critics may keep at the end, and the sparsity of that.

    A network must not end with more connections than it starts with, where methods prune.
    """
    starts = methods.initial_sparsity(sparsity)
    by_network = starts if isinstance(starts, Mapping) else dict.fromkeys(sizes, starts or 0.0)
    actor, critic = (sizes[n] * (1 - by_network.get(n, 0.0)) for n in ("actor", "critic"))
    return actor, critic, 1 - (1 - sparsity) * sum(sizes.values()) / (actor + critic)
