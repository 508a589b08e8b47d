"""Compares an exported policy with its model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.errors import SparsityError
from sb3_sparse.export.observations import Observations, count_of, rows_of

Actor = Callable[[Observations], NDArray[Any]]
"""Maps raw observations, one per row, to flat actions, one per row; further outputs beside them."""
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
    :param worst: the observation for which actions differ most
    :param further: largest ``|a - b|`` of each further output, by its name, divided by its largest
        ``|a|`` for any observation of the same kind, or by 1 if that is smaller; of ``std`` largest
        ``|a - b| / |a|``

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
    further: Mapping[str, float] = field(default_factory=dict)

    @property
    def holds(self) -> bool:
        """Whether the two policies are equal up to rounding."""
        act = self.different == 0 if self.discrete else self.difference <= TOLERANCE
        return act and all(difference <= TOLERANCE for difference in self.further.values())

    def __str__(self) -> str:
        counts = {"recorded": self.recorded, "random": self.random}
        seen = " and ".join(f"{count} {kind}" for kind, count in counts.items() if count)
        seen = f"{seen or 'no'} observations"
        if self.discrete:
            text = f"actions differ for {self.different} of {seen}"
        else:
            text = f"largest difference {self.difference:.1e} on {seen}"
        further = [f"{name} {difference:.1e}" for name, difference in self.further.items()]
        return f"{text}; largest difference of {', '.join(further)}" if further else text


def compare(
    model: Actor,
    exported: Actor,
    recorded: Observations | None,
    random: Observations | None,
    discrete: bool,
    span: NDArray[Any] | float = 0.0,
    further: Mapping[str, int] | None = None,
) -> Parity:
    """Run both policies on all observations.

    :param recorded: observations recorded in an environment; None: none
    :param random: random observations; None: none
    :param span: see :class:`Parity`, shape ``(actions,)``; rounding errors grow with it
    :param further: number of elements of each further output, by its name
    """
    difference, different, worst = 0.0, 0, None
    others = dict.fromkeys(further or {}, 0.0)
    behind = np.cumsum([*(further or {}).values()][::-1])[::-1]
    """Columns from the beginning of each further output to the end of the row."""
    for observations in (recorded, random):
        largest = {name: _Largest(relative=name == "std") for name in others}
        for first in range(0, count_of(observations), BATCH):
            batch = rows_of(observations, first, first + BATCH)
            both = (actor(batch).astype(np.float64) for actor in (model, exported))
            parts = (np.split(rows, -behind, axis=1) for rows in both)
            (ours, theirs), *pairs = zip(*parts, strict=True)
            apart = np.abs(ours - theirs) / np.maximum(np.maximum(1.0, span), np.abs(ours))
            apart = np.where(np.isnan(apart), np.inf, apart).max(axis=1)
            different += int((apart > 0).sum())
            if apart.max() > difference:
                difference = float(apart.max())
                row = int(apart.argmax())
                worst = rows_of(batch, row, row + 1)
            for found, pair in zip(largest.values(), pairs, strict=True):
                found.see(*pair)
        others = {name: max(others[name], found.difference) for name, found in largest.items()}
    seen = (count_of(recorded), count_of(random))
    return Parity(*seen, difference, different, discrete, worst, others)


class _Largest:
    """The largest difference of a further output, and its largest number.

    :param relative: whether each difference counts relative to its own number
    """

    def __init__(self, relative: bool) -> None:
        self.apart, self.size, self.relative = 0.0, 1.0, relative

    def see(self, ours: NDArray[Any], theirs: NDArray[Any]) -> None:
        """Take a batch into account."""
        apart = np.abs(ours - theirs)
        if self.relative:
            with np.errstate(divide="ignore", invalid="ignore"):
                apart = np.where(apart == 0, 0.0, apart / np.abs(ours))
        else:
            self.size = max(self.size, float(np.abs(ours).max()))
        self.apart = max(self.apart, float(np.where(np.isnan(apart), np.inf, apart).max()))

    @property
    def difference(self) -> float:
        """The difference, relative to the size."""
        return self.apart / self.size if np.isfinite(self.size) else np.inf
