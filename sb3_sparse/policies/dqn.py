"""Sparse policies of DQN."""

from __future__ import annotations

from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.dqn.policies import DQNPolicy

from sb3_sparse.policies.mixin import SparsePolicyMixin, with_extractor
from sb3_sparse.policies.spec import NetworkSpec


class SparseDQNPolicy(SparsePolicyMixin, DQNPolicy):
    """Sparse Q network for DQN."""

    networks = {
        "q_net": NetworkSpec(
            roots=("q_net",),
            trunks=("q_net.q_net",),
            heads=("q_net.q_net",),
            target="q_net_target",
        )
    }


SparseDQNMlpPolicy = with_extractor(SparseDQNPolicy, "Mlp", FlattenExtractor)
SparseDQNCnnPolicy = with_extractor(SparseDQNPolicy, "Cnn", NatureCNN)
SparseDQNMultiInputPolicy = with_extractor(SparseDQNPolicy, "MultiInput", CombinedExtractor)
