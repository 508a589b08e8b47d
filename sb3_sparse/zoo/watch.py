"""Callbacks that report the progress of a run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.internals import (
    planned_timesteps,
    timesteps_since_start,
    updates_done,
)
from sb3_sparse.zoo.computing import gradient_steps_of
from sb3_sparse.zoo.match import Match


class Watch(BaseCallback):
    """A callback that is also notified of events outside training. The base class does nothing.

    Example::

        from sb3_sparse.zoo import RunSpec, Watch, train

        class Evaluations(Watch):
            def evaluated(self, step, mean, std, best):
                print(f"step {step}: {mean:.1f}")

        run = RunSpec(n_timesteps=200, eval_freq=100, eval_episodes=1)
        train(run, watch=Evaluations())
    """

    def begins(self, folder: Path, match: Match | None) -> None:
        """Called when a run has its folder and settings; from then on it can be resumed.

        :param match: the parameter match, if the run asks for one
        """

    def evaluated(self, step: int, mean: float, std: float, best: float | None) -> None:
        """Called after each evaluation during training.

        :param step: environment steps trained
        :param mean: mean episode return
        :param std: its standard deviation over episodes
        :param best: the best mean return so far; None: no policy had the requested sparsity yet
        """

    def plays(self, what: str, done: int, planned: int) -> None:
        """Called while episodes are played after training.

        :param what: what is going on, e.g. ``"Evaluating the last policy"``
        :param done: episodes finished
        :param planned: total number of episodes
        """

    def _on_step(self) -> bool:
        return True


class TrainingLog(Watch):
    """Prints a line for each evaluation, tenth of the training, and set of episodes.

    :param say: prints a line; None: print to the current standard output
    """

    def __init__(self, say: Callable[[str], None] | None = None) -> None:
        super().__init__()
        self.say = say or partial(print, file=sys.stdout, flush=True)

    def begins(self, folder: Path, match: Match | None) -> None:
        if match is not None:
            self.say(str(match))

    def evaluated(self, step: int, mean: float, std: float, best: float | None) -> None:
        so_far = "no best yet, still too dense" if best is None else f"best so far {best:.1f}"
        self.say(f"evaluated at step {step}: return {mean:.1f} ± {std:.1f}, {so_far}")

    def plays(self, what: str, done: int, planned: int) -> None:
        if done == 0:
            self.say(f"{what}, episodes: {planned}")

    def _on_training_start(self) -> None:
        self.planned = planned_timesteps(self.model)
        self.tenths = 0
        self.updates = updates_done(self.model)
        self.collected = self.num_timesteps, self.model.start_time
        policy = unwrapped(self.model.policy)
        if isinstance(policy, BaseSparsePolicy):
            sparse = [layer.is_sparse for layer in policy.sparse.layers]
            if any(sparse):
                self.say(f"{sum(sparse)} of {len(sparse)} layers in sparse storage")
        self.say(f"Gradient steps: {gradient_steps_of(self.model)}")

    def _on_step(self) -> bool:
        if self.num_timesteps <= getattr(self.model, "learning_starts", 0):
            self.collected = self.num_timesteps, time.time_ns()
        self.stepped(min(self.num_timesteps, self.planned))
        return True

    def stepped(self, done: int) -> None:
        """Called after each step of the environments.

        :param done: environment steps trained, at most those planned
        """
        tenths = 10 * done // self.planned
        if tenths > self.tenths:
            self.tenths = tenths
            left = self.seconds_left()
            time_left = f", {timedelta(seconds=round(left))} left" if left else ""
            self.say(f"{done} of {self.planned} steps, {self.status()}{time_left}")

    def seconds_left(self) -> float | None:
        """Return the seconds that the rest of the training takes at its speed so far.

        It goes by the mean speed since ``learning_starts``: steps before it are many times as fast.

        :return: None before the first gradient step
        """
        collected, at = self.collected
        done = self.num_timesteps - collected
        if done <= 0 or updates_done(self.model) == self.updates:
            return None
        left = max(self.planned - self.num_timesteps, 0)
        return left * (time.time_ns() - at) / 1e9 / done

    def status(self) -> str:
        """Return the mean return of recent episodes, the sparsity, and steps per second as text.

        The episodes are those of training, which explore. Evaluation time counts, as in SB3's
        ``time/fps``.
        """
        returns = [float(episode["r"]) for episode in self.model.ep_info_buffer or ()]
        text = f"training return {fmean(returns):.1f}" if returns else "training return –"
        policy = unwrapped(self.model.policy)
        if isinstance(policy, BaseSparsePolicy):
            text += f", sparsity {policy.sparse.sparsity:.2%}"
        done = timesteps_since_start(self.model)
        return f"{text}, {done / self._seconds():.0f} steps/s" if done else text

    def _seconds(self) -> float:
        return (time.time_ns() - self.model.start_time) / 1e9


def counting(tell: Callable[[int], None]) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    """Return a callback for SB3's ``evaluate_policy`` that counts finished episodes.

    :param tell: called with the count whenever an episode ends
    """
    told = 0

    def each_step(local: dict[str, Any], _: dict[str, Any]) -> None:
        nonlocal told
        over = len(local["episode_rewards"])
        if over > told:
            told = over
            tell(over)

    return each_step
