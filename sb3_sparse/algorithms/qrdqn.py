"""QR-DQN, of sb3-contrib."""

from __future__ import annotations

from collections.abc import Hashable

from gymnasium import spaces

from sb3_sparse.algorithms.q_learning import QLearning
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.quantiles import argmax, quantile_huber, sum_blocks
from sb3_sparse.policies.contrib import QRDQN as StockQRDQN


class QRDQN(QLearning, StockQRDQN):
    """sb3-contrib's QR-DQN with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import QRDQN, SparsityCallback

        model = QRDQN("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    methods = {
        "quantile_net": ("forward", "extract_features"),
        "quantile_net_target": ("forward", "extract_features"),
    }

    def _depends_on(self) -> tuple[Hashable, ...]:
        return (self.max_grad_norm is None,)

    def _record(self, program: Program, source: str) -> None:
        net, target_net = self.quantile_net, self.quantile_net_target
        assert isinstance(self.action_space, spaces.Discrete)
        actions = int(self.action_space.n)
        batch = self._record_transitions(program, source, net.features_dim, 1)
        next_quantiles = program.network(parts(target_net.quantile_net), batch.next_obs)
        greedy = argmax(sum_blocks(next_quantiles, actions))
        next_value = next_quantiles.pick(greedy, actions)
        target = (batch.rewards + batch.not_done * batch.discounts * next_value).detach()
        taken = program.network(parts(net.quantile_net), batch.obs).pick(batch.actions, actions)
        loss = quantile_huber(taken, target).sum_features().mean() * (1 / target.features)
        program.log("loss", loss)
        clip = None if self.max_grad_norm is None else program.scalar("max_grad_norm")
        program.minimise(loss, self.policy.optimizer, clip=clip)
