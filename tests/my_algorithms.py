"""An algorithm as a user might write it, in one file: SAC that rates its next actions lower."""

from __future__ import annotations

from typing import Any

import stable_baselines3
import torch as th
from stable_baselines3.sac.policies import Actor
from torch.nn import functional as F

from sb3_sparse import NetworkSpec, PassCounts, SparseSACPolicy, register_policy
from sb3_sparse.policies.gaussian_actor import GaussianActor


class CautiousSAC(stable_baselines3.SAC):
    """SAC whose targets are scaled down, with a train() of its own."""

    def __init__(self, *args: Any, caution: float = 0.1, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.caution = caution

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        self.policy.set_training_mode(True)
        for _ in range(gradient_steps):
            data = self.replay_buffer.sample(batch_size)
            with th.no_grad():
                actions, log_prob = self.actor.action_log_prob(data.next_observations)
                values = th.cat(self.critic_target(data.next_observations, actions), dim=1)
                value = values.min(dim=1, keepdim=True).values - 0.1 * log_prob.reshape(-1, 1)
                target = data.rewards + (1 - data.dones) * self.gamma * (1 - self.caution) * value
            loss = sum(F.mse_loss(q, target) for q in self.critic(data.observations, data.actions))
            self.critic.optimizer.zero_grad()
            loss.backward()
            self.critic.optimizer.step()
            actions, log_prob = self.actor.action_log_prob(data.observations)
            values = th.cat(self.critic(data.observations, actions), dim=1)
            loss = (0.1 * log_prob.reshape(-1, 1) - values.min(dim=1, keepdim=True).values).mean()
            self.actor.optimizer.zero_grad()
            loss.backward()
            self.actor.optimizer.step()
        self._n_updates += gradient_steps


class CautiousActor(GaussianActor, Actor):
    """SAC's actor behind one more layer."""

    paths = (("first", "latent_pi", "mu"), ("first", "latent_pi", "log_std"))

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.first = th.nn.Sequential(
            th.nn.Linear(self.features_dim, self.features_dim), th.nn.ReLU()
        )

    def extract_features(self, obs: Any, features_extractor: Any) -> th.Tensor:
        return self.first(super().extract_features(obs, features_extractor))


def passes(model: CautiousSAC) -> list[PassCounts]:
    return [
        PassCounts("actor", 2, 1),
        PassCounts("critic", 1, 1),
        PassCounts("critic", 1, through=1),
        PassCounts("critic", 1, target=True),
    ]


@register_policy(CautiousSAC, passes=passes)
class CautiousPolicy(SparseSACPolicy):
    """Sparse actor and critics for CautiousSAC."""

    actor_class = CautiousActor
    acting = ("actor.features_extractor", "actor.first", "actor.latent_pi", "actor.mu")
    networks = {
        "actor": NetworkSpec(
            roots=("actor.first", "actor.latent_pi", "actor.mu", "actor.log_std"),
            trunks=("actor.first",),
            heads=("actor.mu", "actor.log_std"),
            owner="actor",
        ),
        "critic": SparseSACPolicy.networks["critic"],
    }
