"""DQN."""

from __future__ import annotations

import stable_baselines3

from sb3_sparse.algorithms.q_learning import QLearning
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program


class DQN(QLearning, stable_baselines3.DQN):
    """Stable-Baselines3's DQN with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import DQN, SparsityCallback

        model = DQN("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    methods = {
        "q_net": ("forward", "extract_features"),
        "q_net_target": ("forward", "extract_features"),
    }

    def _record(self, program: Program, source: str) -> None:
        batch = self._record_transitions(program, source, self.q_net.features_dim, 1)
        next_q = program.network(parts(self.q_net_target.q_net), batch.next_obs).max_features()
        target_q = batch.rewards + batch.not_done * batch.discounts * next_q
        q = program.network(parts(self.q_net.q_net), batch.obs).pick(batch.actions)
        loss = (q - target_q.detach()).huber().mean()
        program.log("loss", loss)
        program.minimise(loss, self.policy.optimizer, clip=program.scalar("max_grad_norm"))
