"""Searches for the sparsity that a model's return allows.

Each step depends on the finished levels alone, so an interrupted search resumes as if nothing had
happened.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from sb3_sparse.compress.guard import Interval, change, judge, mean_interval, tolerance

SHRINK = 0.6
"""Density of a level, relative to the one before."""
BISECTIONS = 2
DIGITS = 6


@dataclass(frozen=True)
class Level:
    """One sparsity that was tried.

    :param sparsity: sparsity of the acting network
    :param nnz: active connections of the acting network
    :param verdict: ``"passed"``, ``"failed"``, ``"undecided"`` (which counts as failed), or
        ``"done"`` in a search without a guard
    :param returns: episode returns, paired with the baseline's
    :param change: change of the mean return against the baseline
    """

    sparsity: float
    nnz: int
    verdict: str
    returns: tuple[float, ...]
    change: Interval

    @property
    def accepted(self) -> bool:
        """Whether the search continues from its model."""
        return self.verdict in ("passed", "done")

    def __str__(self) -> str:
        mean = mean_interval(self.returns)
        whole = mean.mean - self.change.mean
        return (
            f"sparsity {self.sparsity:.2%} ({self.nnz:,} connections): return {mean} over "
            f"{len(self.returns)} episodes, change {self.change.share_of(whole)}: {self.verdict}"
        )


def next_sparsity(
    levels: Sequence[Level], start: float, goal: float | None, floor: float
) -> float | None:
    """Return the sparsity to try after these levels; None: the search is over.

    Each level multiplies the density by 0.6, until ``goal`` is reached or a level is not accepted.
    Then the gap between the last accepted density and the first that was not is halved twice, on a
    logarithmic scale.

    :param levels: finished levels, in order
    :param start: sparsity of the original model
    :param goal: sparsity to end at; None: as high as levels are accepted
    :param floor: density below which no layer can lose more connections
    """
    passed = min([1.0 - start, *(1.0 - level.sparsity for level in levels if level.accepted)])
    failed = [1.0 - level.sparsity for level in levels if not level.accepted]
    if goal is not None:
        reached = any(level.sparsity == goal for level in levels)
        return None if reached else min(goal, _sparsity(passed * SHRINK))
    if not failed:
        density = passed * SHRINK
        return _sparsity(density) if density >= floor else None
    first = next(number for number, level in enumerate(levels) if not level.accepted)
    if len(levels) - first - 1 >= BISECTIONS:
        return None
    return _sparsity(math.sqrt(passed * max(failed)))


def _sparsity(density: float) -> float:
    return round(1.0 - density, DIGITS)


class Pruner(Protocol):
    """Prunes, fine-tunes and evaluates for a search."""

    def make(self, number: int, sparsity: float) -> int:
        """Make the candidate: prune and fine-tune the last accepted model; return its nnz."""

    def returns(self, baseline: bool, batch: int) -> list[float]:
        """Return the returns of a numbered batch of episodes, of the baseline or the candidate."""

    def accept(self, number: int) -> None:
        """Accept the candidate, and save it to disk."""


@dataclass(frozen=True)
class Rules:
    """The rules of a search.

    :param start: sparsity of the original model
    :param floor: density below which no layer can lose more connections
    :param max_drop: largest drop, as a share of the baseline's return; None: there is no guard
    :param goal: sparsity to end at; None: the guard decides
    :param batches: largest number of batches of episodes for a level
    """

    start: float
    floor: float
    max_drop: float | None
    goal: float | None
    batches: int


def search(
    rules: Rules,
    pruner: Pruner,
    baseline: dict[int, list[float]],
    levels: list[Level],
    save: Callable[[], None],
    say: Callable[[str], None],
) -> None:
    """Try levels until the rules end the search.

    :param baseline: returns of the baseline by batch; new batches are added
    :param levels: finished levels; new ones are appended
    :param save: called after each level and each batch of the baseline
    :param say: called with a line for each level
    """

    def baseline_of(batch: int) -> list[float]:
        if batch not in baseline:
            baseline[batch] = pruner.returns(True, batch)
            save()
        return baseline[batch]

    first = baseline_of(0)
    if rules.max_drop is not None:
        tolerance(first, rules.max_drop)  # raises before anything is trained
    while True:
        sparsity = next_sparsity(levels, rules.start, rules.goal, rules.floor)
        if sparsity is None:
            return
        number = len(levels) + 1
        nnz = pruner.make(number, sparsity)
        level = _judged(rules, pruner, baseline_of, sparsity, nnz)
        if level.accepted:
            pruner.accept(number)
        levels.append(level)
        save()
        say(f"Level {number}: {level}")


def _judged(
    rules: Rules,
    pruner: Pruner,
    baseline_of: Callable[[int], list[float]],
    sparsity: float,
    nnz: int,
) -> Level:
    """Evaluate the candidate until there is a decision or no batch is left."""
    candidate: list[float] = []
    whole: list[float] = []
    verdict = "undecided"
    for batch in range(rules.batches):
        candidate += pruner.returns(False, batch)
        whole += baseline_of(batch)
        if rules.max_drop is None:
            verdict = "done"
        else:
            verdict = judge(change(candidate, whole), tolerance(whole, rules.max_drop))
        if verdict != "undecided":
            break
    return Level(sparsity, nnz, verdict, tuple(candidate), change(candidate, whole))
