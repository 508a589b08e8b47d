"""Sparse policies of PPO, A2C and TRPO."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.networks.simba import initialise
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.fast_distributions import FastCategorical, FastGaussian, fast_distribution
from sb3_sparse.policies.fast_forward import FastForward, overrides
from sb3_sparse.policies.fast_predict import Actions
from sb3_sparse.policies.registry import register_policy, register_variant, variants_of
from sb3_sparse.policies.simba import SimbaPolicy, with_simba
from sb3_sparse.policies.spec import NetworkSpec, PassCounts

ACTOR = ("mlp_extractor.policy_net", "action_net")
CRITIC = ("mlp_extractor.value_net", "value_net")


class NoSuchAttribute(UnsupportedError, AttributeError):
    """A sparse policy lacks an attribute that an unsupported algorithm asks for."""


def on_policy_passes(model: Any) -> list[PassCounts]:
    """The passes of a gradient step of PPO and A2C."""
    return [PassCounts(name, 1, 1, shares=False) for name in ("actor", "critic")]


@register_policy(PPO, passes=on_policy_passes, own_attribute="clip_range")
@register_policy(A2C, passes=on_policy_passes)
class SparseActorCriticPolicy(BaseSparsePolicy, ActorCriticPolicy):
    """Sparse actor and value network for PPO, A2C and TRPO; a shared extractor is the actor's.

    Example::

        from sb3_sparse import PPO, SparseActorCriticPolicy

        kwargs = dict(sparsity=0.9, distribution="uniform")
        model = PPO(SparseActorCriticPolicy, "CartPole-v1", policy_kwargs=kwargs)
    """

    acting = ("pi_features_extractor", *ACTOR)
    estimate = "output"
    valuing = ("vf_features_extractor", *CRITIC)
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
    functional_gradients = True  # of TRPO; a policy is not told which algorithm makes it
    _fast_forward: Mapping[str, FastForward] = {}

    def use_kernels(self) -> None:
        if self.use_sde:
            return  # its distribution needs the features of the actor too
        self.action_dist = fast_distribution(self.action_dist)
        acts = ("_get_action_dist_from_latent",)
        self._fast_forward = {
            "actor": FastForward((ACTOR,), acts),
            "critic": FastForward((CRITIC,)),
        }
        if self.share_features_extractor:
            self._fast_forward["both"] = FastForward((ACTOR, CRITIC), acts)

    def _results(self, networks: str, obs: Any, extractor: str) -> list[th.Tensor] | None:
        fast = self._fast_forward.get(networks)
        return None if fast is None else fast.results(self, obs, extractor)

    def forward(
        self, obs: Any, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """As in SB3: actions, values of shape ``(n, 1)`` and log probabilities ``(n,)``."""
        results = self._actor_and_critic(obs) if self._fast_forward else None
        acted = None if results is None else self._act(results[0], deterministic)
        if results is None or acted is None:
            return super().forward(obs, deterministic)
        actions, log_prob = acted
        return actions.view(-1, *self.action_space.shape), results[1], log_prob  # type: ignore[misc]

    def _actor_and_critic(self, obs: Any) -> list[th.Tensor] | None:
        """Outputs of actor and critic; None: the modules have to be called."""
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

    def _fast_actions(self, observations: Actions, deterministic: bool) -> Actions | None:
        if not self._fast_forward or overrides(self, ("get_distribution",)):
            return None
        results = self._fast_forward["actor"].from_numpy(self, observations)
        if results is None:
            return None
        acted = self._act(th.from_numpy(results[0]), deterministic)
        return None if acted is None else acted[0].numpy()

    def _act(self, result: th.Tensor, deterministic: bool) -> tuple[th.Tensor, th.Tensor] | None:
        """Actions and log probabilities, from the output of the actor."""
        if isinstance(self.action_dist, FastGaussian):
            return self.action_dist.act(result, self.log_std, deterministic)
        if isinstance(self.action_dist, FastCategorical):
            return self.action_dist.act(result, deterministic)
        distribution = self._distribution(result)
        actions = distribution.get_actions(deterministic)
        return actions, distribution.log_prob(actions)

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["_modules"][name]  # the most frequent case
        except KeyError:
            pass
        if name == "lstm_actor":  # RecurrentPPO reads it before it checks the class
            raise NoSuchAttribute(
                "RecurrentPPO has no sparse policy, since an LSTM cannot be masked; PPO, A2C and "
                "TRPO have one"
            )
        return super().__getattr__(name)

    def _initial_gain(self, layer_name: str) -> float:
        if not self.ortho_init:
            return 1.0
        return {"action_net": 0.01, "value_net": 1.0}.get(layer_name, math.sqrt(2))


SparseActorCriticMlpPolicy, SparseActorCriticCnnPolicy, SparseActorCriticMultiInputPolicy = (
    variants_of(SparseActorCriticPolicy)
)


@register_variant(SparseActorCriticPolicy, "Simba")
class SparseActorCriticSimbaPolicy(SimbaPolicy, SparseActorCriticPolicy):
    """Sparse SimBa networks for PPO, A2C and TRPO.

    ``ortho_init`` affects only the output layers.

    Example::

        from sb3_sparse import PPO

        kwargs = dict(sparsity=0.8, net_arch=dict(pi=[64], vf=[64, 64]))
        model = PPO("SparseSimbaPolicy", "CartPole-v1", policy_kwargs=kwargs)
    """

    default_arch = {"pi": [128], "vf": [256, 256]}
    default_optimizer_kwargs = {"eps": 1e-5}  # as SB3 has it for Adam

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        extractor: Any = self.mlp_extractor
        for name in ("policy_net", "value_net"):
            network = with_simba(getattr(extractor, name), has_output=False)
            setattr(extractor, name, network.to(self.device))

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        initialise(self.mlp_extractor)  # SB3 has drawn all layers anew for ortho_init
        if not self.ortho_init:
            initialise(self.action_net)
            initialise(self.value_net)

    def _initial_gain(self, layer_name: str) -> float:
        if self.ortho_init and layer_name in ("action_net", "value_net"):
            return SparseActorCriticPolicy._initial_gain(self, layer_name)
        return super()._initial_gain(layer_name)
