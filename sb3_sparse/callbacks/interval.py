"""The base class of callbacks that act between rounds of gradient steps."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse.errors import ConfigError, warn
from sb3_sparse.policies.internals import updates_done
from sb3_sparse.sparsity.numeric import is_whole

ACTED_UP_TO = "resets_up_to"
"""Attribute of a model, saved with it: the gradient steps up to which resets are done."""


class IntervalCallback(BaseCallback):
    """Acts each time that gradient steps have passed a multiple of an interval.

    It acts at the start of the rollout after the step that is due, so before a checkpoint of that
    moment is saved; after the last round of a training it acts when the training ends, if
    ``acts_at_end``, else when the next one begins. It knows when to act from the steps that the
    algorithm has counted, and so does a resumed training.

    :param interval: gradient steps between two actions
    :param verbose: as in SB3
    :raises ConfigError: if it is no whole number, 1 or more; in training, inside a callback that
        passes on steps only
    """

    model: OffPolicyAlgorithm
    acts_at_end: ClassVar[bool] = True
    """Whether it acts when a training ends; else, what is due then is due at the next start."""

    def __init__(self, interval: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.interval = interval
        check_whole(interval=interval)

    @abstractmethod
    def act(self, step: int) -> None:
        """Act.

        :param step: gradient steps that the algorithm has taken
        """

    def _init_callback(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise ConfigError(
                f"{type(self).__name__} is for algorithms with a replay buffer, such as DQN, SAC "
                f"and TD3, got {type(self.model).__name__}"
            )

    def _on_training_start(self) -> None:
        self._sees_rollouts = False
        self._began = done = updates_done(self.model)
        # Nothing is due of steps that were trained without the callback.
        self._note(done if self.acts_at_end else getattr(self.model, ACTED_UP_TO, done))

    def _on_rollout_start(self) -> None:
        self._sees_rollouts = True
        self._act_if_due()

    def _on_step(self) -> bool:
        if not self._sees_rollouts:
            name = type(self).__name__
            raise ConfigError(
                f"{name} acts when rollouts begin, of which a callback such as EveryNTimesteps "
                f"tells it nothing; put it beside, not inside: callback=[..., {name}(...)]"
            )
        return True

    def _on_training_end(self) -> None:
        if self.acts_at_end:
            self._act_if_due()
        began, done = self._began, updates_done(self.model)
        if done // self.interval == began // self.interval:
            warn(
                f"{type(self).__name__}: this training of {done - began} gradient steps reached no "
                f"multiple of {self.interval}, the interval; train longer, or choose a smaller one"
            )

    def _act_if_due(self) -> None:
        done = updates_done(self.model)
        due = done // self.interval > self._done // self.interval
        self._note(done)
        if due:
            self.act(done)

    def _note(self, steps: int) -> None:
        """Note up to which gradient step everything that was due is done."""
        self._done = steps
        if not self.acts_at_end:
            setattr(self.model, ACTED_UP_TO, steps)


def check_whole(**values: object) -> None:
    """Check that values are whole numbers, 1 or more.

    :raises ConfigError: naming the first that is not
    """
    for name, value in values.items():
        if not is_whole(value) or value < 1:  # type: ignore[operator]
            raise ConfigError(f"{name} must be a whole number, 1 or more, got {value!r}")
