"""Sparse policies of PPO, A2C and TRPO."""

from __future__ import annotations

import math
from typing import Any

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.policies.mixin import SparsePolicyMixin, with_extractor
from sb3_sparse.policies.spec import NetworkSpec


class NoSuchPart(UnsupportedError, AttributeError):
    """Another algorithm's policy has the attribute, and a sparse one has not."""


class SparseActorCriticPolicy(SparsePolicyMixin, ActorCriticPolicy):
    """Sparse actor and value network for PPO, A2C and TRPO; a shared extractor is the actor's."""

    networks = {
        "actor": NetworkSpec(
            roots=("pi_features_extractor", "mlp_extractor.policy_net", "action_net"),
            trunks=("mlp_extractor.policy_net",),
            heads=("action_net",),
        ),
        "critic": NetworkSpec(
            roots=("vf_features_extractor", "mlp_extractor.value_net", "value_net"),
            trunks=("mlp_extractor.value_net",),
            heads=("value_net",),
        ),
    }
    functional_gradients = True  # TRPO's actor; SB3 does not say which algorithm builds the policy

    def __getattr__(self, name: str) -> Any:
        if name == "lstm_actor":  # what RecurrentPPO asks for first, before it checks the class
            raise NoSuchPart(
                "RecurrentPPO has no sparse policy, since an LSTM cannot be masked; PPO, A2C and "
                "TRPO have one"
            )
        return super().__getattr__(name)

    def _initial_gain(self, layer_name: str) -> float:
        if not self.ortho_init:
            return 1.0
        return {"action_net": 0.01, "value_net": 1.0}.get(layer_name, math.sqrt(2))


SparseActorCriticMlpPolicy = with_extractor(SparseActorCriticPolicy, "Mlp", FlattenExtractor)
SparseActorCriticCnnPolicy = with_extractor(SparseActorCriticPolicy, "Cnn", NatureCNN)
SparseActorCriticMultiInputPolicy = with_extractor(
    SparseActorCriticPolicy, "MultiInput", CombinedExtractor
)
