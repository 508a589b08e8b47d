"""What a run tells whoever watches it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.zoo.match import Match


class Watch(BaseCallback):
    """A callback that is also told what happens outside of training. Here it does nothing."""

    def begins(self, folder: Path, match: Match | None) -> None:
        """A run has its folder and its settings; from here on it can be gone on with.

        :param match: what was built to match a sparse network's parameters
        """

    def evaluated(self, step: int, mean: float, std: float, best: float | None) -> None:
        """An evaluation during training is over.

        :param step: environment steps trained
        :param mean: mean episode return
        :param std: its standard deviation over episodes
        :param best: the best mean return so far; None: no policy had the sparsity asked for yet
        """

    def plays(self, what: str, done: int, planned: int) -> None:
        """Episodes are played after training.

        :param what: whose, e.g. ``"Last policy"``
        :param done: episodes that are over
        :param planned: episodes in all
        """

    def _on_step(self) -> bool:
        return True


def counting(tell: Callable[[int], None]) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    """A callback for SB3's ``evaluate_policy`` that tells how many episodes are over.

    :param tell: called whenever one more is
    """
    told = 0

    def each_step(local: dict[str, Any], _: dict[str, Any]) -> None:
        nonlocal told
        over = len(local["episode_rewards"])
        if over > told:
            told = over
            tell(over)

    return each_step
