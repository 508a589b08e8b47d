"""TQC, of sb3-contrib."""

from __future__ import annotations

from collections.abc import Hashable

from sb3_sparse.algorithms.soft import SoftActorCritic
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.quantiles import quantile_huber, sort
from sb3_sparse.fused.values import Value
from sb3_sparse.policies.contrib import TQC as StockTQC


class TQC(SoftActorCritic, StockTQC):
    """sb3-contrib's TQC with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import TQC, SparsityCallback

        model = TQC("SparsePolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.9))
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    def _depends_on(self) -> tuple[Hashable, ...]:
        return *super()._depends_on(), self.top_quantiles_to_drop_per_net

    def _next_values(self, program: Program, x: Value) -> Value:
        critic = self.critic
        kept = critic.quantiles_total - self.top_quantiles_to_drop_per_net * critic.n_critics
        if not 1 <= kept <= critic.quantiles_total:
            raise NotCovered(f"a target of {kept} among {critic.quantiles_total} quantiles")
        networks = [program.network(parts(q), x) for q in self.critic_target.q_networks]
        return sort(program.joined(networks))[:kept]

    def _critic_loss(self, program: Program, x: Value, target: Value) -> Value:
        losses = [
            quantile_huber(program.network(parts(q), x), target).mean()
            for q in self.critic.q_networks
        ]
        return sum(losses[1:], losses[0]) * (1 / (len(losses) * target.features))

    def _value(self, program: Program, x: Value) -> Value:
        means = [program.network(parts(q), x).sum_features() for q in self.critic.q_networks]
        return sum(means[1:], means[0]) * (1 / int(self.critic.quantiles_total))
