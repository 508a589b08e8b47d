"""Registers the sparse policies under names that every SB3 algorithm understands."""

from __future__ import annotations

from typing import Any, NoReturn

from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_sparse.errors import MissingExtra, UnsupportedError
from sb3_sparse.policies import actor_critic, dqn, sac, td3

SparsePolicy = "SparsePolicy"
"""The sparse policy of whichever algorithm it is passed to."""
PREFIXES = ("", "Mlp", "Cnn", "MultiInput")


class _UnsupportedPolicy(BasePolicy):
    """Stands in where no sparse policy exists, and says so."""

    algorithm: str

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        raise UnsupportedError(
            f"{self.algorithm} has no sparse policy; supported are "
            f"{', '.join(supported_algorithms())}"
        )

    def _predict(self, observation: Any, deterministic: bool = False) -> NoReturn:
        raise AssertionError("never built")


_registered: dict[str, type[BaseAlgorithm]] = {}


def supported_algorithms() -> dict[str, type[BaseAlgorithm]]:
    """The algorithms that a sparse policy is registered for, by name."""
    return dict(_registered)


def _register(algorithm: type[BaseAlgorithm], module: Any, stem: str) -> None:
    for prefix in PREFIXES:
        policy = getattr(module, f"{stem}{prefix}Policy", None)
        if policy is not None:
            algorithm.policy_aliases[f"Sparse{prefix}Policy"] = policy
    _registered[algorithm.__name__] = algorithm


def _refuse(algorithm: type[BaseAlgorithm]) -> None:
    stand_in = type(
        f"No{algorithm.__name__}Policy", (_UnsupportedPolicy,), {"algorithm": algorithm.__name__}
    )
    for prefix in PREFIXES:
        algorithm.policy_aliases[f"Sparse{prefix}Policy"] = stand_in


def register_policies() -> None:
    """Add the names to ``policy_aliases`` of every supported algorithm that is installed."""
    _register(DQN, dqn, "SparseDQN")
    _register(SAC, sac, "SparseSAC")
    _register(TD3, td3, "SparseTD3")
    _register(DDPG, td3, "SparseTD3")
    for algorithm in (PPO, A2C):
        _register(algorithm, actor_critic, "SparseActorCritic")
    try:
        from sb3_sparse.policies import contrib
    except MissingExtra:
        return
    from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO

    _register(TQC, contrib, "SparseTQC")
    _register(QRDQN, contrib, "SparseQRDQN")
    _register(CrossQ, contrib, "SparseCrossQ")
    _register(TRPO, actor_critic, "SparseActorCritic")
    for unsupported in (ARS, MaskablePPO, RecurrentPPO):
        _refuse(unsupported)


register_policies()
