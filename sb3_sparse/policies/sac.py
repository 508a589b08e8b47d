"""Sparse policies of SAC."""

from __future__ import annotations

from typing import Any

from stable_baselines3 import SAC
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_sparse.policies.critics import SparseCriticsMixin
from sb3_sparse.policies.gaussian_actor import GaussianActor
from sb3_sparse.policies.registry import register_policy, register_variant, variants_of
from sb3_sparse.policies.simba import SimbaActingModule, SimbaContinuousCritic, SimbaPolicy
from sb3_sparse.policies.spec import NetworkSpec, PassCounts

GAUSSIAN_ACTOR = NetworkSpec(
    roots=("actor",),
    trunks=("actor.latent_pi",),
    heads=("actor.mu", "actor.log_std"),
    owner="actor",
)
GAUSSIAN_ACTING = ("actor.features_extractor", "actor.latent_pi", "actor.mu")
TWIN_CRITIC = NetworkSpec(
    roots=("critic",),
    trunks=("critic.qf*",),
    heads=("critic.qf*",),
    target="critic_target",
    owner="critic",
)


class SparseSACActor(GaussianActor, Actor):
    """Actor of SAC."""


def sac_passes(model: Any) -> list[PassCounts]:
    """The passes of a gradient step of SAC and TQC."""
    return [
        PassCounts("actor", 2, 1),  # of the observations, and of the next ones
        PassCounts("critic", 1, 1),
        PassCounts("critic", 1, through=1),  # of the actor's actions
        PassCounts("critic", 1, target=True),
    ]


@register_policy(SAC, passes=sac_passes)
class SparseSACPolicy(SparseCriticsMixin, SACPolicy):
    """Sparse actor and critics for SAC.

    Example::

        from sb3_sparse import SAC, SparseSACPolicy

        sparsity = {"actor": 0.95, "critic": 0.8}
        model = SAC(SparseSACPolicy, "Pendulum-v1", policy_kwargs=dict(sparsity=sparsity))
    """

    acting = GAUSSIAN_ACTING
    actor_class = SparseSACActor
    networks = {"actor": GAUSSIAN_ACTOR, "critic": TWIN_CRITIC}


SparseSACMlpPolicy, SparseSACCnnPolicy, SparseSACMultiInputPolicy = variants_of(SparseSACPolicy)


class SimbaSACActor(SimbaActingModule, SparseSACActor):
    """Actor of SAC that is a SimBa network."""


@register_variant(SparseSACPolicy, "Simba")
class SparseSACSimbaPolicy(SimbaPolicy, SparseSACPolicy):
    """Sparse SimBa networks for SAC.

    Example::

        from sb3_sparse import SAC

        kwargs = dict(sparsity=0.9, net_arch=dict(pi=[64], qf=[128, 128]))
        model = SAC("SparseSimbaPolicy", "Pendulum-v1", policy_kwargs=kwargs)
    """

    actor_class = SimbaSACActor
    critic_class = SimbaContinuousCritic
