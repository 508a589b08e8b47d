"""Sparse policies of PPO, A2C and TRPO."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.policies.acting import Actions
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.registry import register_policy, with_extractor
from sb3_sparse.policies.sampling import QuickCategorical, QuickGaussian, quick
from sb3_sparse.policies.shortcut import Shortcut, untouched
from sb3_sparse.policies.spec import NetworkSpec, PassCounts

ACTOR = ("mlp_extractor.policy_net", "action_net")
CRITIC = ("mlp_extractor.value_net", "value_net")


class NoSuchPart(UnsupportedError, AttributeError):
    """Another algorithm's policy has the attribute, and a sparse one has not."""


def on_policy_passes(model: Any) -> list[PassCounts]:
    """The passes of a gradient step of PPO and A2C."""
    return [PassCounts(name, 1, 1, shares=False) for name in ("actor", "critic")]


@register_policy(PPO, passes=on_policy_passes, told_by="clip_range")
@register_policy(A2C, passes=on_policy_passes)
class SparseActorCriticPolicy(BaseSparsePolicy, ActorCriticPolicy):
    """Sparse actor and value network for PPO, A2C and TRPO; a shared extractor is the actor's."""

    acting = ("pi_features_extractor", *ACTOR)
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
    _shortcuts: Mapping[str, Shortcut] = {}

    def use_kernels(self) -> None:
        if self.use_sde:
            return  # its distribution asks for the actor's features too
        self.action_dist = quick(self.action_dist)
        acts = ("_get_action_dist_from_latent",)
        self._shortcuts = {"actor": Shortcut((ACTOR,), acts), "critic": Shortcut((CRITIC,))}
        if self.share_features_extractor:
            self._shortcuts["both"] = Shortcut((ACTOR, CRITIC), acts)

    def _results(self, networks: str, obs: Any, extractor: str) -> list[th.Tensor] | None:
        shortcut = self._shortcuts.get(networks)
        return None if shortcut is None else shortcut.results(self, obs, extractor)

    def forward(
        self, obs: Any, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """As in SB3: actions, values of shape ``(n, 1)`` and log probabilities ``(n,)``."""
        results = self._actor_and_critic(obs) if self._shortcuts else None
        acted = None if results is None else self._act(results[0], deterministic)
        if results is None or acted is None:
            return super().forward(obs, deterministic)
        actions, log_prob = acted
        return actions.view(-1, *self.action_space.shape), results[1], log_prob  # type: ignore[misc]

    def _actor_and_critic(self, obs: Any) -> list[th.Tensor] | None:
        """What the actor's head and the critic give; None where modules must be called."""
        if self.share_features_extractor:
            return self._results("both", obs, "features_extractor")
        mean = self._results("actor", obs, "pi_features_extractor")
        values = None if mean is None else self._results("critic", obs, "vf_features_extractor")
        return None if mean is None or values is None else mean + values

    def get_distribution(self, obs: Any) -> Distribution:
        """As in SB3."""
        results = self._results("actor", obs, "pi_features_extractor")
        if results is None:
            return super().get_distribution(obs)
        return self._distribution(results[0])

    def _distribution(self, result: th.Tensor) -> Distribution:
        if isinstance(self.action_dist, DiagGaussianDistribution):
            return self.action_dist.proba_distribution(result, self.log_std)
        return self.action_dist.proba_distribution(action_logits=result)

    def predict_values(self, obs: Any) -> th.Tensor:
        """As in SB3, shape ``(n, 1)``."""
        results = self._results("critic", obs, "vf_features_extractor")
        return super().predict_values(obs) if results is None else results[0]

    def _choose(self, observations: Actions, deterministic: bool) -> Actions | None:
        if not self._shortcuts or not untouched(self, ("get_distribution",)):
            return None
        results = self._shortcuts["actor"].of_array(self, observations)
        if results is None:
            return None
        acted = self._act(th.from_numpy(results[0]), deterministic)
        return None if acted is None else acted[0].numpy()

    def _act(self, result: th.Tensor, deterministic: bool) -> tuple[th.Tensor, th.Tensor] | None:
        """Actions and log probabilities of what the actor's head gives."""
        if isinstance(self.action_dist, QuickGaussian):
            return self.action_dist.act(result, self.log_std, deterministic)
        if isinstance(self.action_dist, QuickCategorical):
            return self.action_dist.act(result, deterministic)
        distribution = self._distribution(result)
        actions = distribution.get_actions(deterministic)
        return actions, distribution.log_prob(actions)

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["_modules"][name]  # before torch looks in other places
        except KeyError:
            pass
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
