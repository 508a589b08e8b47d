"""Figures: their registry, and sheets of estimates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from sb3_sparse.errors import check_choice
from sb3_sparse.pages import plot
from sb3_sparse.pages.look import Look
from sb3_sparse.pages.plot import Axes, Drawing, styled
from sb3_sparse.report.data import Array
from sb3_sparse.report.results import Results
from sb3_sparse.report.statistics import Estimate

Draw = Callable[[Results], Drawing]
DrawT = TypeVar("DrawT", bound=Draw)


@dataclass(frozen=True)
class Entry:
    """A registered figure.

    :param title: its heading
    :param caption: what it shows
    :param draw: the function that draws it
    """

    title: str
    caption: str
    draw: Draw


FIGURES: dict[str, Entry] = {}


def figure(name: str, title: str, caption: str) -> Callable[[DrawT], DrawT]:
    """Register the function that draws a figure."""

    def enter(draw: DrawT) -> DrawT:
        FIGURES[name] = Entry(title, caption, draw)
        return draw

    return enter


def check_figures(names: Sequence[str]) -> None:
    """Check names of figures.

    :raises ConfigError: for an unknown name; lists those that are allowed
    """
    for name in names:
        check_choice("figure", name, FIGURES)


class Sheet(plot.Sheet):
    """A sheet that draws estimates, too."""

    def estimates(
        self,
        axes: Axes,
        place: Sequence[Any],
        estimates: Mapping[Any, Estimate],
        x: Sequence[float],
        look: Look,
        label: str,
    ) -> None:
        """Draw estimates as a line, and add their rows.

        :param estimates: the estimates by the value that stands for ``x`` in their rows
        """
        self.note(place, estimates)
        plot.line(axes, x, ends_of(estimates.values()), look, label)

    def note(self, place: Sequence[Any], estimates: Mapping[Any, Estimate]) -> None:
        """Add the rows of estimates."""
        for at, e in estimates.items():
            self.rows.append([*place, at, e.value, e.low, e.high, e.seeds])


def ends_of(estimates: Iterable[Estimate]) -> tuple[Array, Array, Array]:
    """Return the values of estimates, and the lower and upper ends of their intervals."""
    values, low, high = np.array([(e.value, e.low, e.high) for e in estimates]).T
    return values, low, high


def draw(name: str, results: Results) -> Drawing:
    """Draw a figure in the pages' style.

    :raises NotEnoughData: if these runs are not enough for it
    """
    with styled():
        return FIGURES[name].draw(results)
