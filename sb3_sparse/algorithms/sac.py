"""SAC."""

from __future__ import annotations

import stable_baselines3

from sb3_sparse.algorithms.soft import SoftActorCritic
from sb3_sparse.fused.distributions import least_of
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.values import Value


class SAC(SoftActorCritic, stable_baselines3.SAC):
    """Stable-Baselines3's SAC with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import SAC, SparsityCallback

        model = SAC("SparsePolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.9))
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    def _next_values(self, program: Program, x: Value) -> Value:
        return least_of([program.network(parts(q), x) for q in self.critic_target.q_networks])

    def _critic_loss(self, program: Program, x: Value, target: Value) -> Value:
        losses = [
            (program.network(parts(q), x) - target).square().mean() for q in self.critic.q_networks
        ]
        return sum(losses[1:], losses[0]) * 0.5

    def _value(self, program: Program, x: Value) -> Value:
        return least_of([program.network(parts(q), x) for q in self.critic.q_networks])
