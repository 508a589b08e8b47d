"""Training on, where plain ``learn`` would spoil a trained model."""

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
"""Environment steps that a replay buffer shall hold before it is learnt from."""
HALF_WAY = 0.5
"""Progress remaining at which schedules are read."""


class Annealed:
    """A learning rate that falls in a line, from what its schedule has half-way through training.

    ``learn`` on top of a finished training would find the last few percent of a schedule, where a
    linear one is all but 0; and one that stays high leaves the policy wherever the last minibatch
    took it. To start from an earlier rate: learning rate rewinding, arXiv:2003.02389.

    :param schedule: a function of the progress that remains, 1 at the start and 0 at the end
    :param start: progress remaining, as SB3 counts it, when the fine-tuning begins; above 0
    :param lag: progress of one rollout where SB3 asks only after it, so that the last is not lost
    """

    def __init__(self, schedule: Callable[[float], float], start: float, lag: float) -> None:
        self.rate = schedule(HALF_WAY)
        self.start = start
        self.lag = lag

    def __call__(self, progress_remaining: float) -> float:
        remaining = (progress_remaining + self.lag) / self.start
        return self.rate * min(1.0, max(0.0, remaining))


def fine_tune(model: BaseAlgorithm, steps: int) -> None:
    """Train on with masks as they are.

    The learning rate falls to 0, PPO's clip ranges are those half-way through training, and the
    exploration of DQN stays at its end.

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
        finally:  # a distribution of NaN raises an error of torch's, which says less
            check_finite(model.policy.state_dict(), "the model that is fine-tuned")


def fill_buffer(model: BaseAlgorithm) -> int:
    """Let a model act without learning until its replay buffer can be learnt from; steps taken.

    A model that was loaded has an empty buffer, and would soon overfit to its first few steps.
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
    """Attributes of a model that explores no more than at the end of its training."""
    settled: dict[str, Any] = {}
    if hasattr(model, "learning_starts"):
        settled["learning_starts"] = 0
    if hasattr(model, "exploration_schedule"):
        final = vars(model)["exploration_final_eps"]
        settled["exploration_schedule"] = ConstantSchedule(final)
    return settled


@contextmanager
def _changed(model: BaseAlgorithm, **attributes: Any) -> Iterator[None]:
    """Within it, the model has other attributes."""
    before = {name: getattr(model, name) for name in attributes}
    vars(model).update(attributes)
    try:
        yield
    finally:
        vars(model).update(before)
