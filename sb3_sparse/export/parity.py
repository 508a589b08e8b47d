"""Whether an exported policy acts as the model does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.errors import SparsityError
from sb3_sparse.export.observations import Observations, count_of, rows_of

Actor = Callable[[Observations], NDArray[Any]]
"""From raw observations, one a row, to flat actions, one a row."""
TOLERANCE = 1e-5
BATCH = 64


class ParityError(SparsityError, ValueError):
    """An exported policy does not act as the model does; nothing was written."""


@dataclass(frozen=True)
class Parity:
    """How far apart two policies are.

    :param recorded: observations from an environment that both saw
    :param random: random ones
    :param difference: of continuous actions: the largest ``|a - b| / max(1, |a|, span)``, where the
        span is half the range of an action that is squashed into it
    :param different: of discrete ones: observations for which they differ
    :param discrete: which of the two counts
    :param worst: the observation of the difference
    """

    recorded: int
    random: int
    difference: float
    different: int
    discrete: bool
    worst: Observations | None = field(default=None, repr=False, compare=False)

    @property
    def holds(self) -> bool:
        """Whether the two are the same policy, up to rounding."""
        return self.different == 0 if self.discrete else self.difference <= TOLERANCE

    def __str__(self) -> str:
        recorded = f"{self.recorded} recorded and " if self.recorded else ""
        seen = f"{recorded}{self.random} random observations"
        if self.discrete:
            return f"actions differ for {self.different} of {seen}"
        return f"largest difference {self.difference:.1e} on {seen}"


def compare(
    model: Actor,
    exported: Actor,
    recorded: Observations | None,
    random: Observations,
    discrete: bool,
    span: NDArray[Any] | float = 0.0,
) -> Parity:
    """Run both policies on all observations.

    :param recorded: None: there are none
    :param span: see :class:`Parity`, shape ``(actions,)``; rounding grows with it
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
