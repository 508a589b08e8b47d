"""SAC."""

from __future__ import annotations

from typing import Any

import numpy as np
import stable_baselines3
import torch as th
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN

from sb3_sparse.algorithms.training import Fused, features, parts
from sb3_sparse.fused.distributions import least_of, squashed_gaussian
from sb3_sparse.fused.errors import CheckFailed, NotCovered
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Program

METHODS: dict[str, tuple[str, ...]] = {
    "actor": ("action_log_prob", "get_action_dist_params", "extract_features"),
    "critic": ("forward", "extract_features"),
    "critic_target": ("forward", "extract_features"),
}


class SAC(Fused, stable_baselines3.SAC):
    """Stable-Baselines3's SAC; each gradient step of a sparse policy is one call of the kernels."""

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """As in SB3. What programs do not cover, such as images or gSDE, SB3 trains."""
        try:
            self._train_fused(gradient_steps, batch_size)
        except NotCovered as why:
            self._not_covered(why)
            super().train(gradient_steps, batch_size)

    def _optimizers(self) -> list[th.optim.Optimizer]:
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        return optimizers + ([self.ent_coef_optimizer] if self.ent_coef_optimizer else [])

    def _machine(self, batch_size: int, n_step: bool) -> Machine:
        policy = self._trains().check(self.policy, METHODS)
        key = (self.tau, n_step, self.ent_coef_optimizer is None)
        optimizers = self._optimizers()
        return self._trains().machine(
            policy, (*key, *map(id, optimizers)), batch_size, optimizers,
            lambda program: self._record(program, n_step),
        )  # fmt: skip

    def _record(self, program: Program, n_step: bool) -> None:
        """One gradient step."""
        actor: Any = self.actor
        critic, target = self.critic, self.critic_target
        dim = int(np.prod(self.action_space.shape or ()))
        width = actor.features_dim
        obs, next_obs = program.input("obs", width), program.input("next_obs", width)
        actions = program.input("actions", dim)
        rewards, dones = program.input("rewards", 1), program.input("dones", 1)
        discounts = program.input("discounts", 1) if n_step else program.scalar("gamma")

        def act(obs: Any, noise: str) -> Any:
            latent = program.network(parts(actor.latent_pi), obs)
            mean = program.network(parts(actor.mu), latent)
            log_std = program.network(parts(actor.log_std), latent)
            action, log_prob = squashed_gaussian(
                mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX), program.input(noise, dim),
                actor.action_dist.epsilon,
            )  # fmt: skip
            program.check(log_prob, noise)
            return action, log_prob

        action, log_prob = act(obs, "noise")
        if self.ent_coef_optimizer is not None:
            assert self.log_ent_coef is not None
            log_ent_coef = program.parameter(self.log_ent_coef)
            ent_coef = log_ent_coef.exp().detach()
            apart = (log_prob + program.scalar("target_entropy")).detach()
            ent_coef_loss = -(log_ent_coef * apart).mean()
            program.log("ent_coef_loss", ent_coef_loss)
            program.minimise(ent_coef_loss, self.ent_coef_optimizer)
        else:
            ent_coef = program.scalar("ent_coef")
        program.log("ent_coef", ent_coef)

        next_action, next_log_prob = act(next_obs, "next_noise")
        before = program.joined([next_obs, next_action])
        next_q = least_of([program.network(parts(q), before) for q in target.q_networks])
        wanted = rewards + (1.0 - dones) * discounts * (next_q - ent_coef * next_log_prob)
        taken = program.joined([obs, actions])
        losses = [
            (program.network(parts(q), taken) - wanted.detach()).square().mean()
            for q in critic.q_networks
        ]
        critic_loss = sum(losses[1:], losses[0]) * 0.5
        program.log("critic_loss", critic_loss)
        program.minimise(critic_loss, critic.optimizer)

        now = program.joined([obs, action])
        q = least_of([program.network(parts(q), now) for q in critic.q_networks])
        actor_loss = (ent_coef * log_prob - q).mean()
        program.log("actor_loss", actor_loss)
        program.minimise(actor_loss, actor.optimizer)
        program.mark("followed")
        for one, two in zip(critic.q_networks, target.q_networks, strict=True):
            program.follow(parts(one), parts(two), self.tau)

    def _train_fused(self, gradient_steps: int, batch_size: int) -> None:
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._optimizers())
        assert self.replay_buffer is not None
        logged: dict[str, list[float]] = {}
        for step in range(gradient_steps):
            n_step = hasattr(self.replay_buffer, "n_steps")
            machine = self._machine(batch_size, n_step)
            machine.prepare()
            data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            self._load(machine, data)
            last = None if step % self.target_update_interval == 0 else machine.marks["followed"]
            try:
                machine.run(0, last)
            except CheckFailed as failed:
                # SB3's distribution refuses what is not finite, and says what it is.
                first = str(failed) == "noise"
                self.actor.action_log_prob(data.observations if first else data.next_observations)
                raise
            for name in machine.program.logged:
                logged.setdefault(name, []).append(machine.number(name))
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name in ("ent_coef", "actor_loss", "critic_loss", "ent_coef_loss"):
            if name in logged:
                self.logger.record(f"train/{name}", np.mean(logged[name]))

    def _load(self, machine: Machine, data: Any) -> None:
        shape = data.actions.shape
        rows = {
            "obs": features(self.policy, data.observations),
            "next_obs": features(self.policy, data.next_observations),
            "actions": data.actions,
            "rewards": data.rewards,
            "dones": data.dones,
            "noise": th.randn(shape),
            "next_noise": th.randn(shape),
        }
        if data.discounts is not None:
            rows["discounts"] = data.discounts
        machine.load(rows)
        scalars: dict[str, Any] = {"gamma": self.gamma, "target_entropy": self.target_entropy}
        if self.ent_coef_optimizer is None:
            scalars["ent_coef"] = float(self.ent_coef_tensor)
        machine.set(scalars)
