"""TD3 and DDPG."""

from __future__ import annotations

import numpy as np
import stable_baselines3
import torch as th

from sb3_sparse.algorithms.off_policy import OffPolicy
from sb3_sparse.fused.distributions import least_of
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program


class TD3(OffPolicy, stable_baselines3.TD3):
    """Stable-Baselines3's TD3 with fused gradient steps, if the policy is sparse.

    Example::

        from sb3_sparse import TD3, SparsityCallback

        model = TD3("SparsePolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.9))
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """

    methods = {
        "actor": ("forward", "extract_features"),
        "actor_target": ("forward", "extract_features"),
        "critic": ("forward", "q1_forward", "extract_features"),
        "critic_target": ("forward", "extract_features"),
    }

    def _optimizers(self, delayed: bool = True) -> list[th.optim.Optimizer]:
        """The optimizers that take a step.

        :param delayed: whether the actor's is among them
        """
        return [self.critic.optimizer, self.actor.optimizer][: 2 if delayed else 1]

    def _record(self, program: Program, source: str) -> None:
        dim = int(np.prod(self.action_space.shape or ()))
        batch = self._record_transitions(program, source, self.actor.features_dim, dim)
        next_action = program.network(parts(self.actor_target.mu), batch.next_obs)
        next_action = (next_action + program.input("noise", dim)).clamp(-1.0, 1.0)
        before = program.joined([batch.next_obs, next_action])
        targets = self.critic_target.q_networks
        next_q = least_of([program.network(parts(q), before) for q in targets])
        target_q = (batch.rewards + batch.not_done * batch.discounts * next_q).detach()
        taken = program.joined([batch.obs, batch.actions])
        losses = [
            (program.network(parts(q), taken) - target_q).square().mean()
            for q in self.critic.q_networks
        ]
        critic_loss = sum(losses[1:], losses[0])
        program.log("critic_loss", critic_loss)
        program.minimise(critic_loss, self.critic.optimizer)

        program.mark("delayed")  # the actor's part comes after it
        action = program.network(parts(self.actor.mu), batch.obs)
        q1 = program.network(parts(self.critic.q_networks[0]), program.joined([batch.obs, action]))
        actor_loss = -q1.mean()
        program.log("actor_loss", actor_loss)
        program.minimise(actor_loss, self.actor.optimizer)
        tau = program.scalar("tau")
        for one, two in zip(self.critic.q_networks, targets, strict=True):
            program.polyak_update(parts(one), parts(two), tau)
        program.polyak_update(parts(self.actor.mu), parts(self.actor_target.mu), tau)

    def _train_fused(self, gradient_steps: int, batch_size: int = 100) -> None:
        source = self._start_round()
        actor_losses, critic_losses = [], []
        for _ in range(gradient_steps):
            delayed = (self._n_updates + 1) % self.policy_delay == 0
            machine, _ = self._next_batch(batch_size, source, delayed)
            self._n_updates += 1
            shape = (machine.batch, *(self.action_space.shape or ()))
            noise = th.empty(shape).normal_(0, self.target_policy_noise)
            noise = noise.clamp_(-self.target_noise_clip, self.target_noise_clip)
            machine.inputs.load({"noise": noise})
            machine.set({"tau": self.tau})
            machine.run(0, None if delayed else machine.mark("delayed"))
            critic_losses.append(machine.number("critic_loss"))
            if delayed:
                actor_losses.append(machine.number("actor_loss"))
        self._log_round({"actor_loss": actor_losses, "critic_loss": critic_losses})


class DDPG(TD3, stable_baselines3.DDPG):
    """Stable-Baselines3's DDPG with fused gradient steps, those of :class:`TD3`.

    Example::

        from sb3_sparse import DDPG, SparsityCallback

        model = DDPG("SparsePolicy", "Pendulum-v1", policy_kwargs=dict(sparsity=0.9))
        model.why_not_fused()  # None: each gradient step is one call of the kernels
        model.learn(200, callback=SparsityCallback("rigl", update_interval=10))
    """
