"""Which sparsity to try next, and the search that goes by it.

Only the levels that are done decide, so an interrupted search goes on as if nothing had happened.
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

    :param sparsity: of the acting network
    :param nnz: its active connections
    :param verdict: ``"passed"``, ``"failed"``, ``"undecided"`` (which counts as failed), or
        ``"done"`` of a search without a guard
    :param returns: episode returns, paired with the baseline's
    :param change: of the mean return, against the baseline
    """

    sparsity: float
    nnz: int
    verdict: str
    returns: tuple[float, ...]
    change: Interval

    @property
    def accepted(self) -> bool:
        """Whether the search goes on from its model."""
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
    """The sparsity to try after these levels; None: the search is over.

    Densities shrink by 0.6 a level, until ``goal`` is reached or a level is not accepted; then the
    gap between the last that was and the first that was not is halved twice, in the logarithm.

    :param levels: done so far, in order
    :param start: sparsity that the model has
    :param goal: sparsity to end at; None: as high as levels are accepted
    :param floor: density below which no layer can lose anything more
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
    """What a search needs done."""

    def make(self, number: int, sparsity: float) -> int:
        """Prune the last accepted model and fine-tune it, as the candidate; its connections."""

    def returns(self, baseline: bool, batch: int) -> list[float]:
        """Returns of a numbered batch of episodes, of the baseline or the candidate."""

    def accept(self, number: int) -> None:
        """Keep the candidate, on the disk too."""


@dataclass(frozen=True)
class Rules:
    """What a search goes by.

    :param start: sparsity that the model has
    :param floor: density below which nothing more can go
    :param max_drop: share of the baseline's return; None: there is no guard
    :param goal: sparsity to end at; None: the guard says
    :param batches: most batches of episodes to evaluate a level by
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
    """Try levels until the rules end it.

    :param baseline: returns of the baseline so far, by batch; grows
    :param levels: done so far; grows
    :param save: called when a level is done, or a batch of the baseline
    :param say: told of each level
    """

    def baseline_of(batch: int) -> list[float]:
        if batch not in baseline:
            baseline[batch] = pruner.returns(True, batch)
            save()
        return baseline[batch]

    first = baseline_of(0)
    if rules.max_drop is not None:
        tolerance(first, rules.max_drop)  # refused before anything is trained
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
    """Evaluate the candidate until it is decided, or the episodes are used up."""
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
