"""What DQN and QR-DQN have in common: one network, and a target that is copied now and then."""

from __future__ import annotations

from typing import Any

import torch as th

from sb3_sparse.algorithms.off_policy import OffPolicy


class QLearning(OffPolicy):
    """Base class of algorithms that learn the values of discrete actions.

    Subclasses record a gradient step that logs ``"loss"``, and also inherit the algorithm, which
    has this attribute.
    """

    max_grad_norm: Any

    follows = False

    def _optimizers(self) -> list[th.optim.Optimizer]:
        return [self.policy.optimizer]

    def _train_fused(self, gradient_steps: int, batch_size: int = 100) -> None:
        source = self._start_round()
        losses = []
        for _ in range(gradient_steps):
            machine, _ = self._next_batch(batch_size, source)
            if self.max_grad_norm is not None:
                machine.set({"max_grad_norm": self.max_grad_norm})
            machine.run()
            losses.append(machine.number("loss"))
        self._n_updates += gradient_steps
        self._log_round({"loss": losses})
