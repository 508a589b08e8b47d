"""Sparse policies of TD3 and DDPG."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3 import DDPG, TD3
from stable_baselines3.td3.policies import Actor, TD3Policy

from sb3_sparse.policies.critics import SparseCriticsMixin
from sb3_sparse.policies.fast_predict import Actions
from sb3_sparse.policies.modules import ActingModule
from sb3_sparse.policies.registry import register_policy, register_variant, variants_of
from sb3_sparse.policies.sac import TWIN_CRITIC
from sb3_sparse.policies.simba import SimbaActingModule, SimbaContinuousCritic, SimbaPolicy
from sb3_sparse.policies.spec import NetworkSpec, PassCounts


class SparseTD3Actor(ActingModule, Actor):
    """Actor of TD3 and DDPG."""

    paths = (("mu",),)

    def forward(self, obs: Any) -> th.Tensor:
        """As in SB3, shape ``(n, dim)``."""
        results = self.results(obs)
        return super().forward(obs) if results is None else results[0]

    def actions_from(self, results: list[Actions], deterministic: bool) -> Actions:
        """The output of the network, shape ``(n, dim)``."""
        return results[0]


def td3_passes(model: Any) -> list[PassCounts]:
    """The passes of a gradient step of TD3 and DDPG."""
    share = 1 / model.policy_delay
    first = "critic.qf[!0]*"  # the actor's loss takes the first critic alone
    return [
        PassCounts("actor", 1, target=True),
        PassCounts("critic", 1, target=True),
        PassCounts("critic", 1, 1),
        PassCounts("actor", share, share),
        PassCounts("critic", share, through=share, leaves_out=first),
    ]


@register_policy(TD3, passes=td3_passes)
@register_policy(DDPG, passes=td3_passes)
class SparseTD3Policy(SparseCriticsMixin, TD3Policy):
    """Sparse actor and critics for TD3 and DDPG.

    Example::

        from sb3_sparse import TD3, SparseTD3Policy

        kwargs = dict(sparsity=0.9, dense_layers=["output"])
        model = TD3(SparseTD3Policy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    acting = ("actor.features_extractor", "actor.mu")
    actor_class = SparseTD3Actor
    networks = {
        "actor": NetworkSpec(
            roots=("actor",),
            trunks=("actor.mu",),
            heads=("actor.mu",),
            target="actor_target",
            owner="actor",
        ),
        "critic": TWIN_CRITIC,
    }


SparseTD3MlpPolicy, SparseTD3CnnPolicy, SparseTD3MultiInputPolicy = variants_of(SparseTD3Policy)


class SimbaTD3Actor(SimbaActingModule, SparseTD3Actor):
    """Actor of TD3 and DDPG that is a SimBa network."""


@register_variant(SparseTD3Policy, "Simba")
class SparseTD3SimbaPolicy(SimbaPolicy, SparseTD3Policy):
    """Sparse SimBa networks for TD3 and DDPG.

    Example::

        from sb3_sparse import TD3

        model = TD3("SparseSimbaPolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.8))
    """

    actor_class = SimbaTD3Actor
    critic_class = SimbaContinuousCritic
