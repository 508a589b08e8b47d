"""Sparse policies of TD3 and DDPG."""

from __future__ import annotations

from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from stable_baselines3.td3.policies import TD3Policy

from sb3_sparse.policies.critics import SparseContinuousCritic
from sb3_sparse.policies.mixin import SparsePolicyMixin, with_extractor
from sb3_sparse.policies.sac import TWIN_CRITIC
from sb3_sparse.policies.spec import NetworkSpec


class SparseTD3Policy(SparsePolicyMixin, TD3Policy):
    """Sparse actor and critics for TD3 and DDPG."""

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

    def make_critic(
        self, features_extractor: BaseFeaturesExtractor | None = None
    ) -> SparseContinuousCritic:
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return SparseContinuousCritic(**kwargs).to(self.device)


SparseTD3MlpPolicy = with_extractor(SparseTD3Policy, "Mlp", FlattenExtractor)
SparseTD3CnnPolicy = with_extractor(SparseTD3Policy, "Cnn", NatureCNN)
SparseTD3MultiInputPolicy = with_extractor(SparseTD3Policy, "MultiInput", CombinedExtractor)
