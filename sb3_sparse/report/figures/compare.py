"""Lines of methods at sparsities, laid out to be compared: at most four in a panel."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sb3_sparse.pages.backend import Axes, Figure
from sb3_sparse.pages.plot import GREY
from sb3_sparse.report.data import Array
from sb3_sparse.report.figures.grid import Grid, Place, Row
from sb3_sparse.report.methods import DENSE, headline, in_order, name_of, percent

MOST_LINES, MOST_ROWS = 4, 9
Line = tuple[str, float, str]
"""Method, sparsity, and all other settings."""


def no_runs(one: Axes) -> None:
    """Say in a panel that there are no runs for it."""
    one.text(
        0.5, 0.5, "no runs", transform=one.transAxes, color=GREY, ha="center", va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 2}, zorder=5,
    )  # fmt: skip


@dataclass(frozen=True)
class Panel:
    """A panel of :func:`compared`.

    :param axes: where it is drawn; outside the figure if there is no room in it
    :param place: what it is about
    :param level: the sparsity
    :param lines: the lines that belong into it
    :param named: the method that its row or column names, so that no legend must
    """

    axes: Axes
    place: Place
    level: float
    lines: Sequence[Line]
    named: str = ""

    def text(self, label: str) -> str:
        """Return the text of a method in the legend; empty for none."""
        return "" if label == self.named else name_of(label)


def compared(
    heads: Sequence[str],
    lines: Mapping[Place, Collection[Line]],
    *,
    x: str,
    y: str,
    level_text: str = "{} sparse",
    dense_everywhere: bool = True,
    methods_across: bool = True,
) -> tuple[Grid, list[Panel]]:
    """Lay out lines: a row for each place, and a column for each sparsity.

    If a panel would have more than four lines, it is divided into one for each method, beside the
    dense network of full size. If that makes more than nine rows of sparsities, each place shows
    one, and the others are in the figure's numbers alone.

    :param lines: the lines of each place
    :param level_text: names a column
    :param dense_everywhere: whether the dense network of full size belongs to each sparsity
    :param methods_across: whether divided panels stand in a row for each sparsity, or each method
    :return: the grid, and its panels with their lines
    """
    every = {line for found in lines.values() for line in found}
    shared = {line for line in every if dense_everywhere and line[0] == DENSE}
    levels = sorted({level for _, level, _ in every - shared}) or [0.0]
    names = [level_text.format(percent(level)) if every - shared else "" for level in levels]
    labels = in_order({label for label, *_ in every - shared})

    def at(place: Place, level: float, label: str = "") -> list[Line]:
        inside = [
            line for line in lines[place]
            if line in shared or (line[1] == level and label in ("", line[0]))
        ]  # fmt: skip
        order = in_order({line[0] for line in inside})
        return sorted(inside, key=lambda line: (order.index(line[0]), *line[1:]))

    panels: list[Panel] = []
    if max(len(at(place, level)) for place in lines for level in levels) <= MOST_LINES:
        rows = [Row(place) for place in lines]
        grid = Grid(heads, rows, names, x=x, y=y)
        for i, row in enumerate(rows):
            for j, level in enumerate(levels):
                panels.append(Panel(grid.at(i, j), row.place, level, at(row.place, level)))
    else:
        texts = [name_of(label) for label in labels]
        across, down = (texts, names) if methods_across else (names, texts)

        def here(place: Place, i: int, j: int) -> tuple[float, str, list[Line]]:
            level = levels[i if methods_across else j]
            label = labels[j if methods_across else i]
            return level, label, at(place, level, label)

        kept = [
            (place, i) for place in lines for i in range(len(down))
            if any(set(here(place, i, j)[2]) - shared for j in range(len(across)))
        ]  # fmt: skip
        shown = kept
        if methods_across and len(kept) > MOST_ROWS:
            best = {
                place: headline(levels[i] for other, i in kept if other == place) for place in lines
            }
            shown = [(place, i) for place, i in kept if levels[i] == best[place]]
        if len({i for _, i in shown}) == 1:
            down = [""] * len(down)
        grid = Grid(heads, [Row(place, down[i]) for place, i in shown], across, x=x, y=y)
        outside = Figure().subplots()
        for place, i in kept:
            for j in range(len(across)):
                level, label, inside = here(place, i, j)
                axes = grid.at(shown.index((place, i)), j) if (place, i) in shown else outside
                panels.append(Panel(axes, place, level, inside, label))
        if shown != kept:
            names = [names[i] for i in sorted({i for _, i in shown})]
            grid.remarks = [
                "all sparsities of a task but one, as there are too many; the CSV has their numbers"
            ]
    for panel in panels:
        if shared.issuperset(panel.lines) and every - shared:
            no_runs(panel.axes)
    if len(names) == 1 and names[0] not in grid.names[: not grid.flowing]:
        grid.title = ", ".join(text for text in (grid.title, names[0]) if text)
    return grid, panels


def stacked(seeds: Sequence[Mapping[float, float]]) -> tuple[list[float], Array]:
    """Return the points that all curves have, and the curves there, shape ``[seeds, n]``."""
    x = sorted(set.intersection(*(set(curve) for curve in seeds)))
    return x, np.array([[curve[at] for at in x] for curve in seeds], dtype=np.float64)
