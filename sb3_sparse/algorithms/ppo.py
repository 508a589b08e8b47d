"""PPO."""

from __future__ import annotations

from collections import defaultdict
from functools import partial

import numpy as np
import stable_baselines3

from sb3_sparse.algorithms.on_policy import METHODS, OnPolicy
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Program

LOGGED = {
    "entropy_loss": "train/entropy_loss",
    "policy_loss": "train/policy_gradient_loss",
    "value_loss": "train/value_loss",
    "clip_fraction": "train/clip_fraction",
}
TITLES = (
    "train/entropy_loss",
    "train/policy_gradient_loss",
    "train/value_loss",
    "train/approx_kl",
    "train/clip_fraction",
)
"""Logged values in SB3's order."""


class PPO(OnPolicy, stable_baselines3.PPO):
    """Stable-Baselines3's PPO with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import PPO, SparsityCallback

        model = PPO("SparsePolicy", "CartPole-v1", policy_kwargs=dict(sparsity=0.9), n_steps=64)
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    def _next_machine(self) -> Machine:
        self._trains().begin(self, METHODS)
        total = self.rollout_buffer.buffer_size * self.rollout_buffer.n_envs
        return self._machine(min(self.batch_size, total))

    def _machine(self, batch: int) -> Machine:
        normalised = self.normalize_advantage and batch > 1
        clipped = self.clip_range_vf is not None
        return self._trains().machine(
            (normalised, clipped), max(batch, self.batch_size), [self.policy.optimizer],
            lambda program: self._record(program, normalised, clipped),
        )  # fmt: skip

    def _record(self, program: Program, normalised: bool, clipped: bool) -> None:
        """Record one gradient step."""
        values, log_prob, entropy = self._record_policy(program)
        advantages = program.input("advantages", 1)
        if normalised:
            advantages = self._normalised(advantages)
        log_ratio = log_prob - program.input("old_log_prob", 1)
        ratio = log_ratio.exp()
        bound = program.scalar("clip_range")
        within = advantages * ratio.clamp(1.0 - bound, 1.0 + bound)
        policy_loss = -(advantages * ratio).least(within).mean()
        program.log("clip_fraction", bound.less((ratio - 1.0).abs()).mean())
        program.log("approx_kl", (ratio - 1.0 - log_ratio).mean())
        if clipped:
            old = program.input("old_values", 1)
            most = program.scalar("clip_range_vf")
            values = old + (values - old).clamp(-most, most)
        self._minimise(program, policy_loss, values, entropy)

    def _train_fused(self) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        remaining = self._current_progress_remaining
        clip_range = self.clip_range(remaining)  # type: ignore[operator]
        settings = {**self._coefficients(), "clip_range": clip_range}
        if self.clip_range_vf is not None:
            settings["clip_range_vf"] = self.clip_range_vf(remaining)  # type: ignore[operator]
        self._next_machine()  # before anything is drawn

        logged = defaultdict(list)
        continue_training = True
        for epoch in range(self.n_epochs):
            divergences = []
            for part in self._minibatches(self.batch_size):
                machine = self._machine(part.size)
                machine.set(settings)
                self._hand_over(machine, part)
                step = machine.steps[0] if self.target_kl is not None else None
                machine.run(0, step, partial(self._raise_error, part))
                for name, title in LOGGED.items():
                    logged[title].append(machine.number(name))
                divergence = machine.number("approx_kl")
                divergences.append(np.float32(divergence))
                loss = machine.number("loss")
                if self.target_kl is not None and divergence > 1.5 * self.target_kl:
                    continue_training = False
                    if self.verbose >= 1:
                        print(
                            f"Early stopping at step {epoch} due to reaching max kl: "
                            f"{divergence:.2f}"
                        )
                    break
                if step is not None:
                    machine.run(step)
            self._n_updates += 1
            if not continue_training:
                break

        record = self.logger.record
        logged["train/approx_kl"] = divergences
        for title in TITLES:
            record(title, np.mean(logged[title]))
        record("train/loss", loss)
        record("train/explained_variance", self._explained_variance())
        self._record_std()
        record("train/n_updates", self._n_updates, exclude="tensorboard")
        record("train/clip_range", settings["clip_range"])
        if self.clip_range_vf is not None:
            record("train/clip_range_vf", settings["clip_range_vf"])
