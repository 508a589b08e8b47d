"""Sparse policies of DQN."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork

from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.fast_predict import Actions
from sb3_sparse.policies.modules import ActingModule, PredictsByModule
from sb3_sparse.policies.registry import register_policy, register_variant, variants_of
from sb3_sparse.policies.simba import SimbaActingModule, SimbaPolicy
from sb3_sparse.policies.spec import NetworkSpec, PassCounts


class SparseQNetwork(ActingModule, QNetwork):
    """Q network of DQN."""

    paths = (("q_net",),)

    def forward(self, obs: Any) -> th.Tensor:
        """As in SB3, shape ``(n, actions)``."""
        results = self.results(obs)
        return super().forward(obs) if results is None else results[0]

    def actions_from(self, results: list[Actions], deterministic: bool) -> Actions:
        """The best actions, shape ``(n,)``."""
        best: Actions = results[0].argmax(axis=1)
        return best


def value_passes(network: str) -> Callable[[Any], list[PassCounts]]:
    """The passes of a gradient step of DQN and QR-DQN."""
    return lambda model: [PassCounts(network, 1, 1), PassCounts(network, 1, target=True)]


@register_policy(DQN, passes=value_passes("q_net"))
class SparseDQNPolicy(PredictsByModule, BaseSparsePolicy, DQNPolicy):
    """Sparse Q network for DQN.

    Example::

        from sb3_sparse import DQN, SparseDQNPolicy

        kwargs = dict(sparsity=0.9, net_arch=[256, 256])
        model = DQN(SparseDQNPolicy, "CartPole-v1", policy_kwargs=kwargs)
    """

    acting = ("q_net.features_extractor", "q_net.q_net")
    estimate = "largest"
    action_spaces = (spaces.Discrete,)
    q_net_class: ClassVar[type[SparseQNetwork]] = SparseQNetwork
    q_net: SparseQNetwork
    networks = {
        "q_net": NetworkSpec(
            roots=("q_net",),
            trunks=("q_net.q_net",),
            heads=("q_net.q_net",),
            target="q_net_target",
        )
    }

    def make_q_net(self) -> SparseQNetwork:
        """As in SB3, with :attr:`q_net_class`."""
        kwargs = self._update_features_extractor(self.net_args, features_extractor=None)
        return self.q_net_class(**kwargs).to(self.device)


SparseDQNMlpPolicy, SparseDQNCnnPolicy, SparseDQNMultiInputPolicy = variants_of(SparseDQNPolicy)


class SimbaQNetwork(SimbaActingModule, SparseQNetwork):
    """Q network of DQN that is a SimBa network."""


@register_variant(SparseDQNPolicy, "Simba")
class SparseDQNSimbaPolicy(SimbaPolicy, SparseDQNPolicy):
    """Sparse SimBa network for DQN.

    Example::

        from sb3_sparse import DQN

        kwargs = dict(sparsity=0.9, net_arch=[128, 128])
        model = DQN("SparseSimbaPolicy", "CartPole-v1", policy_kwargs=kwargs)
    """

    default_arch = [256, 256]
    q_net_class = SimbaQNetwork
