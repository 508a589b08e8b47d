"""A2C."""

from __future__ import annotations

from functools import partial

import stable_baselines3

from sb3_sparse.algorithms.on_policy import METHODS, OnPolicy
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Program


class A2C(OnPolicy, stable_baselines3.A2C):
    """Stable-Baselines3's A2C with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import A2C, SparsityCallback

        model = A2C("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    def _next_machine(self) -> Machine:
        self._trains().begin(self, METHODS)
        batch = self.rollout_buffer.buffer_size * self.rollout_buffer.n_envs
        key = (self.normalize_advantage,)
        return self._trains().machine(key, batch, [self.policy.optimizer], self._record)

    def _record(self, program: Program) -> None:
        """Record one gradient step."""
        values, log_prob, entropy = self._record_policy(program)
        advantages = program.input("advantages", 1)
        if self.normalize_advantage:
            advantages = self._normalised(advantages)
        self._minimise(program, -(advantages * log_prob).mean(), values, entropy)

    def _train_fused(self) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        machine = self._next_machine()
        machine.set(self._coefficients())
        for part in self._minibatches(None):
            self._hand_over(machine, part)
            machine.run(0, None, partial(self._raise_error, part))
        self._n_updates += 1
        record = self.logger.record
        record("train/n_updates", self._n_updates, exclude="tensorboard")
        record("train/explained_variance", self._explained_variance())
        for name in ("entropy_loss", "policy_loss", "value_loss"):
            record(f"train/{name}", machine.number(name))
        self._record_std()
