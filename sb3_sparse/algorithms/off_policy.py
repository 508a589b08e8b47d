"""Base class of algorithms with a replay buffer: reads its batches."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse.algorithms.base import Fused, features, mean
from sb3_sparse.algorithms.training import Methods
from sb3_sparse.fused.errors import NotCovered
from sb3_sparse.fused.inputs import TYPES
from sb3_sparse.fused.machine import Machine
from sb3_sparse.fused.program import Program
from sb3_sparse.fused.values import Value
from sb3_sparse.policies.fast_forward import takes_vectors

IN_PLACE, SAMPLED, N_STEP = "in place", "sampled", "n-step"
"""Ways to read a replay buffer: its arrays in place, or batches from its own ``sample``."""


class Transitions(NamedTuple):
    """A batch of transitions as values of a program."""

    obs: Value
    next_obs: Value
    actions: Value
    rewards: Value
    not_done: Value
    """0.0 where the episode has ended, else 1.0."""
    discounts: Value


class OffPolicy(Fused, OffPolicyAlgorithm):
    """Base class of algorithms that learn from a replay buffer by fused gradient steps.

    docs/gradient_steps.md has an example of a subclass.
    """

    methods: ClassVar[Methods]
    follows: ClassVar[bool] = True
    """Whether targets follow by Polyak averaging at each gradient step."""

    @abstractmethod
    def _optimizers(self, *details: Any) -> list[th.optim.Optimizer]:
        """The optimizers that take a step."""

    @abstractmethod
    def _record(self, program: Program, source: str) -> None:
        """Record one gradient step."""

    def _depends_on(self) -> tuple[Hashable, ...]:
        """Settings that a recorded gradient step depends on and that may change."""
        return ()

    def _others(self) -> Sequence[th.Tensor]:
        """Parameters that are trained besides the policy's."""
        return ()

    def _begin(self) -> None:
        """Inspect the model before a round of gradient steps.

        :raises NotCovered: if SB3 must take them
        """
        self._trains().begin(self, self.methods, self._others())
        if self.follows and self.tau >= 1:
            raise NotCovered("targets that are copies")

    def _next_machine(self) -> Machine:
        self._begin()
        return self._machine(self.batch_size, self._find_source())

    def _machine(self, batch: int, source: str, *details: Any) -> Machine:
        """Return the machine for a batch size, a source and details of the algorithm."""
        optimizers = self._optimizers(*details)
        build = partial(self._record, source=source)
        return self._trains().machine((source, *self._depends_on()), batch, optimizers, build)

    def _find_source(self) -> str:
        """Choose how to read the replay buffer."""
        buffer = self.replay_buffer
        if (
            type(buffer) is ReplayBuffer
            and self._vec_normalize_env is None
            and vars(buffer).keys().isdisjoint(("sample", "_get_samples", "to_torch"))
            and takes_vectors(self.policy)
            and {buffer.observations.dtype.name, buffer.actions.dtype.name} <= TYPES.keys()
        ):
            return IN_PLACE
        return N_STEP if getattr(buffer, "n_steps", 1) > 1 else SAMPLED

    def _start_round(self) -> str:
        """Start a round of gradient steps; return how to read the replay buffer.

        :raises NotCovered: if SB3 must take them
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._optimizers())
        self._begin()
        return self._find_source()

    def _log_round(self, logged: Mapping[str, Sequence[float]]) -> None:
        """Log the mean of each list of numbers that is not empty, in order."""
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, numbers in logged.items():
            if numbers:
                self.logger.record(f"train/{name}", mean(numbers))

    @staticmethod
    def _record_transitions(
        program: Program, source: str, observations: int, actions: int
    ) -> Transitions:
        """Declare the inputs of a program.

        :param program: the program
        :param source: how the replay buffer is read
        :param observations: features of an observation
        :param actions: numbers in an action
        """
        dones = program.input("dones", 1)
        if source == IN_PLACE:  # a truncated episode has not ended
            dones = dones * (1.0 - program.input("timeouts", 1))
        return Transitions(
            program.input("obs", observations),
            program.input("next_obs", observations),
            program.input("actions", actions),
            program.input("rewards", 1),
            1.0 - dones,
            program.input("discounts", 1) if source == N_STEP else program.scalar("gamma"),
        )

    def _next_batch(self, batch: int, source: str, *details: Any) -> tuple[Machine, Any]:
        """Draw a batch by the same random numbers as SB3, and set it as input.

        :param batch: batch size
        :param source: how to read the replay buffer
        :param details: further arguments of ``_machine``
        :return: the machine, and what the buffer's ``sample`` returned; None if it is read in place
        """
        machine = self._machine(batch, source, *details)  # before anything is drawn
        buffer: Any = self.replay_buffer
        data = None
        if source == IN_PLACE:
            self._point(machine, buffer, batch)
        else:
            data = buffer.sample(batch, env=self._vec_normalize_env)
            source = SAMPLED if data.discounts is None else N_STEP
            machine = self._machine(len(data.rewards), source, *details)
            rows = {
                "obs": features(self.policy, data.observations),
                "next_obs": features(self.policy, data.next_observations),
                "actions": data.actions,
                "rewards": data.rewards,
                "dones": data.dones,
            }
            if source == N_STEP:
                rows["discounts"] = data.discounts
            machine.load(rows)
        machine.set({"gamma": self.gamma})
        return machine, data

    def _observations(self, machine: Machine, data: Any, next_ones: bool) -> th.Tensor:
        """Return the observations of the present batch in the form of SB3's buffer.

        :param data: what the buffer's ``sample`` returned; None if it is read in place
        :param next_ones: whether to give the observations after the step
        """
        if data is not None:
            found: th.Tensor = data.next_observations if next_ones else data.observations
            return found
        buffer: Any = self.replay_buffer
        later = next_ones and buffer.optimize_memory_usage
        index, _ = machine.index("next rows" if later else "rows", machine.batch)
        array = buffer.next_observations if next_ones and not later else buffer.observations
        rows: th.Tensor = buffer.to_torch(array.reshape(-1, *array.shape[2:])[index])
        return rows

    @staticmethod
    def _point(machine: Machine, buffer: ReplayBuffer, batch: int) -> None:
        """Draw rows as ``ReplayBuffer.sample`` does, for the kernels to read in place."""
        size, count = buffer.buffer_size, buffer.n_envs
        if buffer.optimize_memory_usage and buffer.full:
            rows = (np.random.randint(1, size, size=batch) + buffer.pos) % size
        else:
            rows = np.random.randint(0, size if buffer.full else buffer.pos, size=batch)
        envs = np.random.randint(0, high=count, size=(batch,))
        index, at = machine.index("rows", batch)
        np.add(rows * count, envs, out=index)
        if buffer.optimize_memory_usage:
            later, then = machine.index("next rows", batch)
            np.add((rows + 1) % size * count, envs, out=later)
            next_obs = buffer.observations, then
        else:
            next_obs = buffer.next_observations, at
        arrays = {
            "obs": (buffer.observations, at), "next_obs": next_obs,
            "actions": (buffer.actions, at), "rewards": (buffer.rewards, at),
            "dones": (buffer.dones, at), "timeouts": (buffer.timeouts, at),
        }  # fmt: skip
        machine.inputs.point(arrays, lead=2)
