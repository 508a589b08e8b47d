"""Sparse policies of SAC."""

from __future__ import annotations

from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.sac.policies import Actor, SACPolicy

from sb3_sparse.policies.critics import SparseCriticsMixin
from sb3_sparse.policies.extractors import with_extractor
from sb3_sparse.policies.gaussian import GaussianActor
from sb3_sparse.policies.spec import NetworkSpec

GAUSSIAN_ACTOR = NetworkSpec(
    roots=("actor",),
    trunks=("actor.latent_pi",),
    heads=("actor.mu", "actor.log_std"),
    owner="actor",
)
TWIN_CRITIC = NetworkSpec(
    roots=("critic",),
    trunks=("critic.qf*",),
    heads=("critic.qf*",),
    target="critic_target",
    owner="critic",
)


class SparseSACActor(GaussianActor, Actor):
    """Actor of SAC."""


class SparseSACPolicy(SparseCriticsMixin, SACPolicy):
    """Sparse actor and critics for SAC."""

    actor_class = SparseSACActor
    networks = {"actor": GAUSSIAN_ACTOR, "critic": TWIN_CRITIC}


SparseSACMlpPolicy = with_extractor(SparseSACPolicy, "Mlp", FlattenExtractor)
SparseSACCnnPolicy = with_extractor(SparseSACPolicy, "Cnn", NatureCNN)
SparseSACMultiInputPolicy = with_extractor(SparseSACPolicy, "MultiInput", CombinedExtractor)
