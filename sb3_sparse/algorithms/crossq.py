"""CrossQ."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch as th

from sb3_sparse.algorithms.soft import LOGGED, StochasticActor
from sb3_sparse.fused.distributions import least_of
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.policies import contrib
from sb3_sparse.policies.contrib import renorms_of


class CrossQ(StochasticActor, contrib.CrossQ):
    """sb3-contrib's CrossQ with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import CrossQ, SparsityCallback

        kwargs = dict(sparsity=0.9, net_arch=[64, 64])
        model = CrossQ("SparsePolicy", "Pendulum-v1", policy_kwargs=kwargs)
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    follows = False
    methods = {
        "actor": (
            "action_log_prob", "get_action_dist_params", "extract_features", "set_bn_training_mode",
        ),
        "critic": ("forward", "extract_features", "set_bn_training_mode"),
    }  # fmt: skip

    @property
    def _fixed_ent_coef(self) -> th.Tensor:
        if self.log_ent_coef is None:
            return self.ent_coef_tensor
        return self.log_ent_coef.detach().exp()

    def _record(self, program: Program, source: str) -> None:
        actor, critic = self.actor, self.critic
        batch = self._record_transitions(program, source, actor.features_dim, self._action_features)
        ent_coef = self._record_ent_coef(program)
        next_action, next_log_prob = self._act(program, batch.next_obs, "next_noise")
        taken = program.joined([batch.obs, batch.actions])
        before = program.joined([batch.next_obs, next_action])
        both = [program.training_network(parts(q), taken, before) for q in critic.q_networks]
        next_q = least_of([q for _, q in both]) - ent_coef * next_log_prob
        target_q = (batch.rewards + batch.not_done * batch.discounts * next_q).detach()
        losses = [(q - target_q).square().mean() for q, _ in both]
        critic_loss = sum(losses[1:], losses[0]) * 0.5
        program.log("critic_loss", critic_loss)
        program.minimise(critic_loss, critic.optimizer)

        program.mark("delayed")  # the actor's part comes after it
        action, log_prob = self._act(program, batch.obs, "noise", trains=True)
        self._adjust_ent_coef(program, log_prob)
        now = program.joined([batch.obs, action])
        value = least_of([program.network(parts(q), now) for q in critic.q_networks])
        actor_loss = (ent_coef * log_prob - value).mean()
        program.log("actor_loss", actor_loss)
        program.minimise(actor_loss, actor.optimizer)

    def _train_fused(self, gradient_steps: int, batch_size: int = 64) -> None:
        source = self._start_round()
        logged: dict[str, list[float]] = {name: [] for name in LOGGED}
        for step in range(gradient_steps):
            machine, data = self._next_batch(batch_size, source)
            self._n_updates += 1
            delayed = self._n_updates % self.policy_delay == 0
            raise_error = partial(self._raise_error, machine, data)
            self._set_inputs(machine, "next_noise")
            machine.run(0, machine.mark("delayed"), raise_error)
            if step == 0:
                self.critic.set_bn_training_mode(False)  # as SB3's first step does here
            if delayed:
                self._set_inputs(machine, "noise")
                machine.run(machine.mark("delayed"), None, raise_error)
            for name in machine.program.logged:
                if delayed or name in ("ent_coef", "critic_loss"):
                    logged.setdefault(name, []).append(machine.number(name))
        self.actor.set_bn_training_mode(False)
        self._log_round(logged)

    def _raise_error(self, machine: Machine, data: Any, noise: str) -> None:
        """As in the base, where the actor's BatchRenorms are in training mode for its own loss.

        An error leaves them as SB3's does, with running statistics that have moved. Without one,
        the program moves them.
        """
        trains = noise == "noise"
        self.actor.set_bn_training_mode(trains)
        buffers = [buffer for norm in renorms_of(self.actor) for buffer in norm.buffers()]
        before = [buffer.clone() for buffer in buffers]
        super()._raise_error(machine, data, noise)
        for buffer, kept in zip(buffers, before, strict=True):
            buffer.copy_(kept)
