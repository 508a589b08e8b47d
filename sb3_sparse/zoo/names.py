"""The names that the settings of a run may hold, by owner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sb3_sparse.policies.arguments import arguments_of
from sb3_sparse.policies.registry import SparsePolicy, policy_named

if TYPE_CHECKING:  # imported when settings are checked, not when names are read
    from stable_baselines3.common.base_class import BaseAlgorithm

ZOO_KEYS = frozenset(
    {
        "callback",
        "env_kwargs",
        "env_wrapper",
        "frame_stack",
        "monitor_kwargs",
        "n_envs",
        "n_timesteps",
        "noise_std",
        "noise_type",
        "normalize",
        "policy",
        "policy_kwargs",
        "vec_env_wrapper",
    }
)
"""Keys that rl-zoo itself reads, beside the arguments of the algorithm's constructor."""
SET_BY_THE_RUN = frozenset({"device", "seed", "tensorboard_log", "verbose"})
"""Constructor arguments of every algorithm that separate options set."""


@dataclass(frozen=True)
class Names:
    """The names of the arguments that settings may hold, by owner. They do not overlap.

    :param algorithm: arguments of the algorithm's constructor and of rl-zoo
    :param policy: arguments of the sparse policy
    :param schedule: arguments of the SparsityCallback, except its method
    :param robust_value: arguments of the RobustValueCallback
    """

    algorithm: frozenset[str]
    policy: frozenset[str]
    schedule: frozenset[str]
    robust_value: frozenset[str]

    @classmethod
    def of(cls, algorithm: type[BaseAlgorithm], alias: str = SparsePolicy) -> Names:
        """Return the names that the settings of an algorithm may hold.

        :param alias: the name of the policy
        :raises ConfigError: if the algorithm has no such policy
        """
        from sb3_sparse.callback import SparsityCallback
        from sb3_sparse.callbacks import RobustValueCallback

        return cls(
            (arguments_of(algorithm) - SET_BY_THE_RUN) | ZOO_KEYS,
            arguments_of(policy_named(algorithm, alias)),
            arguments_of(SparsityCallback) - {"method", "verbose"},
            arguments_of(RobustValueCallback) - {"verbose"},
        )

    @property
    def all(self) -> frozenset[str]:
        """The names of all owners."""
        return self.algorithm | self.policy | self.schedule | self.robust_value
