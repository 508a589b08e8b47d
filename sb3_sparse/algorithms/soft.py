"""What SAC, TQC and CrossQ have in common: a stochastic actor, a learned weight of its entropy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN

from sb3_sparse.algorithms.off_policy import OffPolicy
from sb3_sparse.fused.distributions import squashed_gaussian
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.values import Value

LOGGED = ("ent_coef", "actor_loss", "critic_loss", "ent_coef_loss")
"""Logged values in SB3's order."""


class StochasticActor(OffPolicy):
    """Base class of algorithms with SAC's actor and entropy coefficient.

    Subclasses also inherit the algorithm, which has these attributes.
    """

    actor: Any
    critic: Any
    log_ent_coef: th.Tensor | None
    ent_coef_optimizer: Any
    ent_coef_tensor: th.Tensor
    target_entropy: Any

    @property
    def _action_features(self) -> int:
        return int(np.prod(self.action_space.shape or ()))

    def _optimizers(self) -> list[th.optim.Optimizer]:
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        return optimizers + ([self.ent_coef_optimizer] if self.ent_coef_optimizer else [])

    @property
    def _learned(self) -> th.Tensor | None:
        """The logarithm of the entropy coefficient; None where that is not learned."""
        return None if self.ent_coef_optimizer is None else self.log_ent_coef

    @property
    def _fixed_ent_coef(self) -> th.Tensor:
        """The entropy coefficient where it is not learned."""
        return self.ent_coef_tensor

    def _depends_on(self) -> tuple[Hashable, ...]:
        return (id(self._learned),)

    def _others(self) -> list[th.Tensor]:
        return [] if self.log_ent_coef is None else [self.log_ent_coef]

    def _act(
        self, program: Program, obs: Value, noise: str, trains: bool = False
    ) -> tuple[Value, Value]:
        """Record the actor's actions and their log probabilities.

        :param noise: name of the input of standard normal numbers
        :param trains: whether BatchRenorms of the actor are in training mode
        """
        actor, dim = self.actor, self._action_features
        network = parts(actor.latent_pi)
        if trains:
            (latent,) = program.training_network(network, obs)
        else:
            latent = program.network(network, obs)
        mean = program.network(parts(actor.mu), latent)
        log_std = program.network(parts(actor.log_std), latent)
        action, log_prob = squashed_gaussian(
            mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX), program.input(noise, dim),
            actor.action_dist.epsilon,
        )  # fmt: skip
        program.check(log_prob, noise)
        return action, log_prob

    def _record_ent_coef(self, program: Program) -> Value:
        """Record the present entropy coefficient."""
        learned = self._learned
        if learned is None:
            ent_coef = program.scalar("ent_coef")
        else:
            ent_coef = program.parameter(learned).exp().detach()
        program.log("ent_coef", ent_coef)
        return ent_coef

    def _adjust_ent_coef(self, program: Program, log_prob: Value) -> None:
        """Record the step of the entropy coefficient, if it is learned."""
        learned = self._learned
        if learned is None:
            return
        apart = (log_prob + program.scalar("target_entropy")).detach()
        loss = -(program.parameter(learned) * apart).mean()
        program.log("ent_coef_loss", loss)
        program.minimise(loss, self.ent_coef_optimizer)

    def _set_inputs(self, machine: Machine, *noises: str) -> None:
        """Set the numbers of the next gradient step.

        :param noises: inputs for which to draw standard normal numbers, in this order
        """
        shape = (machine.batch, *(self.action_space.shape or ()))
        machine.inputs.load({noise: th.randn(shape) for noise in noises})
        machine.set({"target_entropy": float(self.target_entropy)})
        if self._learned is None:
            machine.set({"ent_coef": float(self._fixed_ent_coef)})

    def _raise_error(self, machine: Machine, data: Any, noise: str) -> None:
        """Let SB3's distribution raise its error, e.g. for means that are not finite."""
        obs = self._observations(machine, data, next_ones=noise == "next_noise")
        with th.no_grad(), th.random.fork_rng(devices=[]):
            self.actor.action_log_prob(obs)


class SoftActorCritic(StochasticActor):
    """Base class of SAC and TQC, whose critics have targets.

    Subclasses say what their critics estimate.
    """

    critic_target: Any
    target_update_interval: int

    methods = {
        "actor": ("action_log_prob", "get_action_dist_params", "extract_features"),
        "critic": ("forward", "extract_features"),
        "critic_target": ("forward", "extract_features"),
    }

    @abstractmethod
    def _next_values(self, program: Program, x: Value) -> Value:
        """Record the target critics' estimate of the return, one number or several.

        :param x: the next observations, with the actor's actions
        """

    @abstractmethod
    def _critic_loss(self, program: Program, x: Value, target: Value) -> Value:
        """Record the loss of the critics.

        :param x: observations and actions of the batch
        :param target: the return to be estimated, as many numbers as :meth:`_next_values` gives
        """

    @abstractmethod
    def _value(self, program: Program, x: Value) -> Value:
        """Record the critics' estimate that the actor maximises, one number.

        :param x: observations, with the actor's actions
        """

    def _record(self, program: Program, source: str) -> None:
        actor, critic = self.actor, self.critic
        batch = self._record_transitions(program, source, actor.features_dim, self._action_features)
        action, log_prob = self._act(program, batch.obs, "noise")
        ent_coef = self._record_ent_coef(program)
        self._adjust_ent_coef(program, log_prob)

        next_action, next_log_prob = self._act(program, batch.next_obs, "next_noise")
        before = program.joined([batch.next_obs, next_action])
        next_value = self._next_values(program, before) - ent_coef * next_log_prob
        target_q = batch.rewards + batch.not_done * batch.discounts * next_value
        taken = program.joined([batch.obs, batch.actions])
        critic_loss = self._critic_loss(program, taken, target_q.detach())
        program.log("critic_loss", critic_loss)
        program.minimise(critic_loss, critic.optimizer)

        now = program.joined([batch.obs, action])
        actor_loss = (ent_coef * log_prob - self._value(program, now)).mean()
        program.log("actor_loss", actor_loss)
        program.minimise(actor_loss, actor.optimizer)
        program.mark("target update")
        for one, two in zip(critic.q_networks, self.critic_target.q_networks, strict=True):
            program.polyak_update(parts(one), parts(two), program.scalar("tau"))

    def _train_fused(self, gradient_steps: int, batch_size: int = 64) -> None:
        source = self._start_round()
        logged: dict[str, list[float]] = {name: [] for name in LOGGED}
        for step in range(gradient_steps):
            machine, data = self._next_batch(batch_size, source)
            self._set_inputs(machine, "noise", "next_noise")
            machine.set({"tau": self.tau})
            last = (
                None if step % self.target_update_interval == 0 else machine.mark("target update")
            )
            machine.run(0, last, partial(self._raise_error, machine, data))
            for name in machine.program.logged:
                logged.setdefault(name, []).append(machine.number(name))
        self._n_updates += gradient_steps
        self._log_round(logged)
