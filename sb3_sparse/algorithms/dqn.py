"""DQN."""

from __future__ import annotations

from typing import Any

import numpy as np
import stable_baselines3

from sb3_sparse.algorithms.training import Fused, features, parts
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Program

METHODS: dict[str, tuple[str, ...]] = {
    "q_net": ("forward", "extract_features"),
    "q_net_target": ("forward", "extract_features"),
}


class DQN(Fused, stable_baselines3.DQN):
    """Stable-Baselines3's DQN; each gradient step of a sparse policy is one call of the kernels."""

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """As in SB3. What programs do not cover, such as images, SB3 trains."""
        try:
            self._train_fused(gradient_steps, batch_size)
        except NotCovered as why:
            self._not_covered(why)
            super().train(gradient_steps, batch_size)

    def _machine(self, batch_size: int, n_step: bool) -> Machine:
        policy = self._trains().check(self.policy, METHODS)
        optimizer = policy.optimizer
        return self._trains().machine(
            policy, (n_step, id(optimizer)), batch_size, [optimizer],
            lambda program: self._record(program, n_step),
        )  # fmt: skip

    def _record(self, program: Program, n_step: bool) -> None:
        """One gradient step."""
        width = self.q_net.features_dim
        obs, next_obs = program.input("obs", width), program.input("next_obs", width)
        actions = program.input("actions", 1)
        rewards, dones = program.input("rewards", 1), program.input("dones", 1)
        discounts = program.input("discounts", 1) if n_step else program.scalar("gamma")

        next_q = program.network(parts(self.q_net_target.q_net), next_obs).max_features()
        wanted = rewards + (1.0 - dones) * discounts * next_q
        q = program.network(parts(self.q_net.q_net), obs).pick(actions)
        loss = (q - wanted.detach()).huber().mean()
        program.log("loss", loss)
        program.minimise(loss, self.policy.optimizer, clip=program.scalar("max_grad_norm"))

    def _train_fused(self, gradient_steps: int, batch_size: int) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        assert self.replay_buffer is not None
        losses = []
        for _ in range(gradient_steps):
            machine = self._machine(batch_size, hasattr(self.replay_buffer, "n_steps"))
            machine.prepare()
            data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            self._load(machine, data)
            machine.run()
            losses.append(machine.number("loss"))
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.mean(losses))

    def _load(self, machine: Machine, data: Any) -> None:
        rows = {
            "obs": features(self.policy, data.observations),
            "next_obs": features(self.policy, data.next_observations),
            "actions": data.actions,
            "rewards": data.rewards,
            "dones": data.dones,
        }
        if data.discounts is not None:
            rows["discounts"] = data.discounts
        machine.load(rows)
        machine.set({"gamma": self.gamma, "max_grad_norm": self.max_grad_norm})
