"""Panels of estimates, one below the other: from five seeds on with an interval, else with dots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_sparse.pages.backend import Axes
from sb3_sparse.pages.lines import BAND, LEAST_FOR_BAND, dots
from sb3_sparse.pages.look import Look
from sb3_sparse.report.figures.grid import Grid, Place, Row
from sb3_sparse.report.methods import percent
from sb3_sparse.report.scores import Panel
from sb3_sparse.report.statistics import Estimate

LINE, MARGIN = 0.27, 0.55  # inches: a row of a panel, and what is around them


def by_sparsity(
    heads: Sequence[str], found: Sequence[Panel], rows: int, x: str
) -> tuple[Grid, list[Axes]]:
    """Lay out a row of panels for each family, a panel for each sparsity.

    :param rows: the most estimates that stand below each other
    :return: the grid, and the panels' axes
    """
    families = list(dict.fromkeys(panel.family for panel in found))
    levels = sorted({panel.level for panel in found})
    grid = Grid(
        heads, [Row(Place(family)) for family in families],
        [f"{percent(level)} sparse" for level in levels], x=x, y="", height=MARGIN + LINE * rows,
    )  # fmt: skip
    tasks = sorted({len(panel.tasks) for panel in found})
    many = " to ".join(map(str, tasks))
    grid.title = f"{grid.title}, {many} task{'s' * (tasks != [1])}".removeprefix(", ")
    grid.counts = {len(scores) for panel in found for scores in panel.scores.values()}
    axes = [grid.at(families.index(one.family), levels.index(one.level)) for one in found]
    for one in grid.axes:
        if one not in axes:
            one.set_visible(False)
    return grid, axes


def estimate(
    one: Axes,
    place: float,
    given: Estimate,
    values: Sequence[float],
    look: Look,
    each: str,
) -> None:
    """Draw an estimate: from five seeds on with its interval, below that with dots.

    :param place: its height in the panel
    :param values: the values of the dots
    :param each: what a dot is, a seed or a run
    """
    if given.seeds >= LEAST_FOR_BAND:
        one.plot(
            [given.low, given.high], [place, place], color=look.color, linewidth=8, alpha=0.35,
            solid_capstyle="butt", gid=BAND,
        )  # fmt: skip
    else:
        spread = np.linspace(-0.2, 0.2, len(values)) if len(values) > 1 else np.zeros(1)
        dots(one, list(values), list(place + spread), look, each)
    one.plot(given.value, place, look.marker, color=look.color, markersize=7.5)
