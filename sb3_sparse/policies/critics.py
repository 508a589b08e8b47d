"""Critics that skip gradients that nobody uses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.modules import ActingModule, PredictsByModule, SparseModule


@contextmanager
def _frozen(module: nn.Module) -> Iterator[None]:
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    for parameter in trained:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)


class SparseCritic(SparseModule):
    """A critic whose own weights get no gradient where its actions have one.

    That is so in the actor's loss of every algorithm: SB3 computes the critic's gradients there too
    and throws them away. The critic's own loss takes its actions from the replay buffer.
    """

    def forward(self, obs: Any, actions: th.Tensor) -> Any:
        with _frozen(self) if actions.requires_grad else nullcontext():
            return super().forward(obs, actions)


class SparseContinuousCritic(SparseCritic, ContinuousCritic):
    """Critic of SAC, TD3 and DDPG."""

    def q1_forward(self, obs: Any, actions: th.Tensor) -> th.Tensor:
        with _frozen(self) if actions.requires_grad else nullcontext():
            return super().q1_forward(obs, actions)


class SparseCriticsMixin(PredictsByModule, BaseSparsePolicy):
    """Policies of algorithms with an actor and critics of its actions."""

    estimate = "min"
    valuing = ("critic.features_extractor", "critic")
    action_spaces = (spaces.Box,)
    actor_class: ClassVar[type[ActingModule]]
    critic_class: ClassVar[type[SparseCritic]] = SparseContinuousCritic
    actor_kwargs: dict[str, Any]
    critic_kwargs: dict[str, Any]

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """As in SB3, with :attr:`actor_class`."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return self.actor_class(**kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """As in SB3, but a :attr:`critic_class`."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return self.critic_class(**kwargs).to(self.device)
