"""Base class of PPO and A2C: minibatches of a rollout."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.utils import explained_variance

from sb3_sparse.algorithms.base import Fused, features
from sb3_sparse.algorithms.training import Methods
from sb3_sparse.fused.distributions import bernoulli, categorical, gaussian, multi_categorical
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.inputs import TYPES
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.optimizers import KNOWN, Known, rmsprop
from sb3_sparse.fused.parts import parts
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.values import Value
from sb3_sparse.policies.fast_forward import takes_vectors
from sb3_sparse.policies.internals import samples

METHODS: Methods = {
    "": ("evaluate_actions", "extract_features", "_get_action_dist_from_latent"),
    "mlp_extractor": ("forward", "forward_actor", "forward_critic"),
}

KNOWN[RMSpropTFLike] = Known(
    ("lr", "alpha", "eps", "weight_decay", "momentum", "centered"), rmsprop(2), ("", "square_avg")
)

ARRAYS = {
    "obs": "observations",
    "actions": "actions",
    "old_values": "values",
    "old_log_prob": "log_probs",
    "advantages": "advantages",
    "returns": "returns",
}
"""The arrays of a rollout buffer by the names of a program's inputs."""


class Minibatch(NamedTuple):
    """A minibatch of a rollout.

    :param size: batch size
    :param data: what the rollout buffer returned; None: programs read its arrays
    :param rows: row numbers in these arrays
    """

    size: int
    data: Any
    rows: Any = None


class OnPolicy(Fused, OnPolicyAlgorithm):
    """Base class of algorithms that learn from rollouts by fused gradient steps.

    A subclass defines ``_next_machine``, ``_record`` and ``_train_fused``, as PPO does.
    """

    def _record_policy(self, program: Program) -> tuple[Value, Value, Value]:
        """Record values, log probabilities and entropy of a batch of observations and actions."""
        policy: Any = self.policy
        both = policy.mlp_extractor
        obs = program.input("obs", policy.features_dim)
        values = program.network(parts(both.value_net, policy.value_net), obs)
        head = program.network(parts(both.policy_net, policy.action_net), obs)
        program.check(head, "distribution")
        space = self.action_space
        if isinstance(space, spaces.Box):
            log_std = program.parameter(policy.log_std)
            # A Gaussian needs a deviation above 0.
            program.check(program.constant(0.0) / log_std.exp(), "distribution")
            actions = program.input("actions", head.features)
            log_prob, entropy = gaussian(head, log_std, actions)
        elif isinstance(space, spaces.Discrete):
            log_prob, entropy = categorical(head, program.input("actions", 1))
        elif isinstance(space, spaces.MultiDiscrete):
            sizes = [int(size) for size in space.nvec]
            actions = program.input("actions", len(sizes))
            log_prob, entropy = multi_categorical(head, actions, sizes)
        elif isinstance(space, spaces.MultiBinary):
            log_prob, entropy = bernoulli(head, program.input("actions", head.features))
        else:
            raise NotCovered(f"actions of type {type(space).__name__}")
        if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
            program.check(log_prob, "distribution")  # for infinite logits
        return values, log_prob, entropy

    def _minimise(
        self, program: Program, policy_loss: Value, values: Value, entropy: Value
    ) -> None:
        """Record the total loss of policy, value network and entropy, and the step."""
        value_loss = (program.input("returns", 1) - values).square().mean()
        entropy_loss = -(entropy.mean() if entropy.batched else entropy)
        loss = (
            policy_loss
            + program.scalar("ent_coef") * entropy_loss
            + program.scalar("vf_coef") * value_loss
        )
        program.log("policy_loss", policy_loss)
        program.log("value_loss", value_loss)
        program.log("entropy_loss", entropy_loss)
        program.log("loss", loss)
        program.minimise(loss, self.policy.optimizer, clip=program.scalar("max_grad_norm"))

    def _coefficients(self) -> dict[str, float]:
        """Return the coefficients that :meth:`_minimise` uses."""
        return {name: getattr(self, name) for name in ("ent_coef", "vf_coef", "max_grad_norm")}

    @staticmethod
    def _normalised(advantages: Value) -> Value:
        centred = advantages - advantages.mean()
        variance = centred.square().sum() / advantages.program.scalar("batch - 1")
        return centred / (variance.sqrt() + 1e-8)

    def _minibatches(self, size: int | None) -> Iterator[Minibatch]:
        """Split the rollout into minibatches by the same random numbers as SB3.

        :param size: size of a minibatch; None: the whole rollout
        """
        buffer: Any = self.rollout_buffer
        total = buffer.buffer_size * buffer.n_envs
        if not (
            type(buffer) is RolloutBuffer
            and vars(buffer).keys().isdisjoint(("get", "_get_samples", "to_torch"))
            and takes_vectors(self.policy)
            and {buffer.observations.dtype.name, buffer.actions.dtype.name} <= TYPES.keys()
        ):
            for data in buffer.get(size):
                yield Minibatch(len(data.advantages), data)
            return
        assert buffer.full
        order = np.random.permutation(total)
        if not buffer.generator_ready:
            for name in ARRAYS.values():
                setattr(buffer, name, buffer.swap_and_flatten(getattr(buffer, name)))
            buffer.generator_ready = True
        for first in range(0, total, size or total):
            rows = order[first : first + (size or total)]
            yield Minibatch(len(rows), None, rows)

    def _hand_over(self, machine: Machine, part: Minibatch) -> None:
        data = part.data
        if data is not None:
            rows = {name: getattr(data, name) for name in ARRAYS if name != "obs"}
            machine.load({"obs": features(self.policy, data.observations), **rows})
            return
        buffer, at = self.rollout_buffer, part.rows.ctypes.data
        machine.set_batch(part.size)
        machine.inputs.point(
            {name: (getattr(buffer, array), at) for name, array in ARRAYS.items()}, lead=1
        )

    def _raise_error(self, part: Minibatch, check: str) -> None:
        """Let SB3's distribution raise its error, e.g. for means that are not finite."""
        data, buffer = part.data, self.rollout_buffer
        if data is None:
            data = samples(buffer, part.rows)
        actions = data.actions
        if isinstance(self.action_space, spaces.Discrete):
            actions = actions.long().flatten()
        with th.no_grad():
            self.policy.evaluate_actions(data.observations, actions)

    def _explained_variance(self) -> Any:
        buffer = self.rollout_buffer
        return explained_variance(buffer.values.flatten(), buffer.returns.flatten())

    def _record_std(self) -> None:
        log_std = getattr(self.policy, "log_std", None)
        if log_std is not None:
            self.logger.record("train/std", float(np.exp(log_std.detach().numpy()).mean()))
