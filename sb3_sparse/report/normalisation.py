"""Scores on one scale over tasks: which score becomes 0, which becomes 1, and by what source."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from statistics import fmean

from sb3_sparse.errors import ConfigError
from sb3_sparse.pages.numbers import counted
from sb3_sparse.report.data import RunData
from sb3_sparse.report.methods import DENSE
from sb3_sparse.zoo.environments import ATARI, DM_CONTROL, game_of, suite_of

# (random play, professional human tester). Source: Mnih et al. 2015 (Nature 518:529), extended data
# table 2. The table of DQN Zoo and rliable differs: its human scores are of a later tester.
HUMAN = {
    "Assault": (222.4, 1496.0),
    "Asterix": (210.0, 8503.0),
    "BeamRider": (363.9, 5775.0),
    "Boxing": (0.1, 4.3),
    "Breakout": (1.7, 31.8),
    "CrazyClimber": (10781.0, 35411.0),
    "DemonAttack": (152.1, 3401.0),
    "Enduro": (0.0, 309.6),
    "FishingDerby": (-91.7, 5.5),
    "MsPacman": (307.3, 15693.0),
    "Pong": (-20.7, 9.3),
    "Qbert": (163.9, 13455.0),
    "SpaceInvaders": (148.0, 1652.0),
    "Tutankham": (11.4, 167.6),
    "VideoPinball": (16257.0, 17298.0),
}
# (uniformly random policy, solved). Random: measured with Gymnasium 1.4, 500 to 5,000 episodes.
# Solved: Gymnasium's reward threshold; Pendulum has none, -150 is about what trained agents reach.
CONTROL_SCALE = {
    "CartPole": (22.0, 475.0),
    "Acrobot": (-499.0, -100.0),
    "MountainCar": (-200.0, -110.0),
    "Pendulum": (-1223.0, -150.0),
}
# (least, greatest) return of an episode. Source: Gymnasium's rewards of a step and limits of steps:
# CartPole-v1 +1 in at most 500, Acrobot-v1 -1 in at most 500, MountainCar-v0 -1 in at most 200,
# Pendulum-v1 at least -(pi^2 + 0.1 * 8^2 + 0.001 * 2^2) in 200. The DeepMind Control Suite: at most
# 1 in each of 1,000 steps (arXiv:1801.00690).
CONTROL_RETURNS = {
    "CartPole": (0.0, 500.0),
    "Acrobot": (-500.0, 0.0),
    "MountainCar": (-200.0, 0.0),
    "Pendulum": (-3254.8, 0.0),
}
SUITE_RETURNS = {DM_CONTROL: (0.0, 1000.0)}
ANY = (-math.inf, math.inf)
References = Mapping[str, tuple[float, float]]
"""The returns that become 0 and 1, by task: e.g. of a random policy, and of one that solves it."""
CURE = "reference_returns in a study's file (docs/studies.md) give a task a scale"
PAIRS = {
    **{name: (*pair, "human-normalised, Mnih et al. 2015") for name, pair in HUMAN.items()},
    **{name: (*pair, "random policy to solved") for name, pair in CONTROL_SCALE.items()},
}


@dataclass(frozen=True)
class Scale:
    """The scale of a task.

    :param zero: the score that becomes 0
    :param one: the score that becomes 1
    :param source: where the two are from
    """

    zero: float
    one: float
    source: str

    def __call__(self, score: float) -> float:
        return (score - self.zero) / (self.one - self.zero)


def possible_returns(env_id: str) -> tuple[float, float]:
    """Return the least and the greatest return of an episode; infinite where none is known."""
    return CONTROL_RETURNS.get(game_of(env_id)) or SUITE_RETURNS.get(suite_of(env_id)) or ANY


class Normaliser:
    """The scales of all families and tasks that have one.

    :param runs: where no scale is fixed, the dense runs of full size among them give it
    :param references: returns that fix the scale of tasks, before all others
    :raises ConfigError: for a pair whose second return is not the greater
    """

    def __init__(self, runs: Iterable[RunData], references: References | None = None) -> None:
        self.scales: dict[tuple[str, str], Scale] = {}
        self.missing: list[str] = []
        trained = [run for run in runs if run.trained]
        for family, env_id in sorted({(run.family, run.env_id) for run in trained}):
            here = [run for run in trained if (run.family, run.env_id) == (family, env_id)]
            scale = _given(env_id, references or {}) or _fixed(env_id) or _by_dense(here)
            if isinstance(scale, Scale):
                self.scales[family, env_id] = scale
            else:
                self.missing.append(f"{family}, {env_id}: {scale}")

    def __call__(self, run: RunData, score: float | None = None) -> float | None:
        """Normalise a run's score, or another return of its task; None without a scale."""
        scale = self.scales.get((run.family, run.env_id))
        return None if scale is None else scale(run.score if score is None else score)

    def within(self, family: str, env_id: str) -> tuple[float, float]:
        """Return the least and the greatest normalised return of an episode of a task."""
        scale = self.scales.get((family, env_id))
        if scale is None:
            return ANY
        low, high = map(scale, possible_returns(env_id))
        return low, high

    def statements(self) -> list[str]:
        """Return a line for each task that tells what 0 and 1 stand for."""
        return [
            f"{family}, {env_id}: 0 stands for a score of {scale.zero:.4g}, 1 for {scale.one:.4g} "
            f"({scale.source})"
            for (family, env_id), scale in self.scales.items()
        ]


def _given(env_id: str, references: References) -> Scale | None:
    pair = references.get(env_id)
    if pair is None:
        return None
    zero, one = pair
    if not zero < one:
        raise ConfigError(
            f"the second of a task's reference returns must be the greater, got {pair} for {env_id}"
        )
    return Scale(zero, one, "reference_returns of the study")


def _fixed(env_id: str) -> Scale | None:
    name = game_of(env_id)
    if name in CONTROL_SCALE or (name in HUMAN and suite_of(env_id) == ATARI):
        return Scale(*PAIRS[name])
    return None


def _by_dense(runs: list[RunData]) -> Scale | str:
    scores = [run.score for run in runs if run.label == DENSE]
    if not scores:
        return "no run of the dense network of full size, whose mean score would be 1"
    mean = fmean(scores)
    if mean <= 0:
        return f"the dense network's mean score is {mean:.6g}, by which nothing can be divided"
    return Scale(0.0, mean, f"the mean of {counted(len(scores), 'dense run')} of full size")
