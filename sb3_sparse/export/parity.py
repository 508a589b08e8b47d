"""Compares an exported policy with its model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.errors import SparsityError
from sb3_sparse.export.observations import Observations, count_of, rows_of

Actor = Callable[[Observations], NDArray[Any]]
"""Maps raw observations, one per row, to flat actions, one per row."""
TOLERANCE = 1e-5
BATCH = 64


class ParityError(SparsityError, ValueError):
    """An exported policy does not act as the model does; nothing was written."""


@dataclass(frozen=True)
class Parity:
    """The difference between two policies.

    :param recorded: number of observations recorded in an environment
    :param random: number of random observations
    :param difference: largest ``|a - b| / max(1, |a|, span)`` of continuous actions, where span is
        half the range that an action is squashed into
    :param different: number of observations for which discrete actions differ
    :param discrete: whether actions are discrete, so that ``different`` counts
    :param worst: the observation with the largest difference

    Example::

        from sb3_sparse.export import Parity

        assert Parity(0, 1000, difference=2e-6, different=0, discrete=False).holds
    """

    recorded: int
    random: int
    difference: float
    different: int
    discrete: bool
    worst: Observations | None = field(default=None, repr=False, compare=False)

    @property
    def holds(self) -> bool:
        """Whether the two policies are equal up to rounding."""
        return self.different == 0 if self.discrete else self.difference <= TOLERANCE

    def __str__(self) -> str:
        counts = {"recorded": self.recorded, "random": self.random}
        seen = " and ".join(f"{count} {kind}" for kind, count in counts.items() if count)
        seen = f"{seen or 'no'} observations"
        if self.discrete:
            return f"actions differ for {self.different} of {seen}"
        return f"largest difference {self.difference:.1e} on {seen}"


def compare(
    model: Actor,
    exported: Actor,
    recorded: Observations | None,
    random: Observations | None,
    discrete: bool,
    span: NDArray[Any] | float = 0.0,
) -> Parity:
    """Run both policies on all observations.

    :param recorded: observations recorded in an environment; None: none
    :param random: random observations; None: none
    :param span: see :class:`Parity`, shape ``(actions,)``; rounding errors grow with it
    """
    difference, different, worst = 0.0, 0, None
    for observations in (recorded, random):
        for first in range(0, count_of(observations), BATCH):
            batch = rows_of(observations, first, first + BATCH)
            ours, theirs = (actor(batch).astype(np.float64) for actor in (model, exported))
            apart = np.abs(ours - theirs) / np.maximum(np.maximum(1.0, span), np.abs(ours))
            apart = np.where(np.isnan(apart), np.inf, apart).max(axis=1)
            different += int((apart > 0).sum())
            if apart.max() > difference:
                difference = float(apart.max())
                row = int(apart.argmax())
                worst = rows_of(batch, row, row + 1)
    return Parity(count_of(recorded), count_of(random), difference, different, discrete, worst)
