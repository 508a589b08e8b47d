"""Fine-tunes a trained model, which plain ``learn`` would spoil."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import ConstantSchedule

from sb3_sparse.loading.zips import check_finite

EXPERIENCE = 10_000
"""Environment steps that a replay buffer must hold before the model learns from it."""
HALF_WAY = 0.5
"""Progress remaining at which schedules are evaluated."""


class Annealed:
    """A learning rate that falls linearly to 0 from its schedule's value half-way through training.

    After a finished training, ``learn`` would use the last few percent of a schedule, where a
    linear one is nearly 0. A rate that stays high would leave the policy wherever the last
    minibatch took it. Source for starting from an earlier rate: learning rate rewinding,
    arXiv:2003.02389.

    :param schedule: a function of the remaining progress, 1 at the start and 0 at the end
    :param start: remaining progress, as SB3 counts it, when fine-tuning begins; above 0
    :param lag: progress of one rollout if SB3 asks after each rollout, so that the last one learns
    """

    def __init__(self, schedule: Callable[[float], float], start: float, lag: float) -> None:
        self.rate = schedule(HALF_WAY)
        self.start = start
        self.lag = lag

    def __call__(self, progress_remaining: float) -> float:
        remaining = (progress_remaining + self.lag) / self.start
        return self.rate * min(1.0, max(0.0, remaining))


def fine_tune(model: BaseAlgorithm, steps: int) -> None:
    """Continue training with fixed masks.

    The learning rate falls to 0, PPO's clip ranges have their values half-way through training, and
    DQN's exploration has its final value.

    :param model: a sparse model with an environment
    :param steps: environment steps
    :raises Diverged: if the network is not finite afterwards
    """
    planned = model.num_timesteps + steps
    lag = model.n_steps * model.n_envs if isinstance(model, OnPolicyAlgorithm) else 0
    changes: dict[str, Any] = {
        "lr_schedule": Annealed(model.lr_schedule, steps / planned, lag / planned)
    }
    for name in ("clip_range", "clip_range_vf"):
        if callable(schedule := getattr(model, name, None)):
            changes[name] = ConstantSchedule(schedule(HALF_WAY))
    with _changed(model, **changes, **_settled(model)):
        try:
            model.learn(steps, reset_num_timesteps=False)
        finally:  # torch's own error about NaN in a distribution says less
            check_finite(model.policy.state_dict(), "the model that is fine-tuned")


def fill_buffer(model: BaseAlgorithm) -> int:
    """Let a model act without learning until its replay buffer is full enough; return the steps.

    A loaded model has an empty buffer, and would overfit to its first few steps.
    """
    if not isinstance(model, OffPolicyAlgorithm):
        return 0
    assert model.replay_buffer is not None
    held = model.replay_buffer.size() * model.n_envs
    room = model.replay_buffer.buffer_size * model.n_envs
    missing = min(room, max(EXPERIENCE, model.batch_size)) - held
    if missing <= 0:
        return 0
    before = model.num_timesteps
    with _changed(model, gradient_steps=0, **_settled(model)):
        model.learn(missing, reset_num_timesteps=False)
    return model.num_timesteps - before


def _settled(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the attributes of a model that explores as at the end of its training."""
    settled: dict[str, Any] = {}
    if hasattr(model, "learning_starts"):
        settled["learning_starts"] = 0
    if hasattr(model, "exploration_schedule"):
        final = vars(model)["exploration_final_eps"]
        settled["exploration_schedule"] = ConstantSchedule(final)
    return settled


@contextmanager
def _changed(model: BaseAlgorithm, **attributes: Any) -> Iterator[None]:
    """Change attributes of a model for the duration of a block."""
    before = {name: getattr(model, name) for name in attributes}
    vars(model).update(attributes)
    try:
        yield
    finally:
        vars(model).update(before)
