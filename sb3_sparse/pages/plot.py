"""Figures of pages in one style: panels, lines with bands, one legend; and how they are written."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sb3_sparse.errors import MissingExtra
from sb3_sparse.files import write_csv, written_whole
from sb3_sparse.intervals import Array
from sb3_sparse.pages.look import Look

try:
    import matplotlib
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import (
        EngFormatter,
        LogLocator,
        MaxNLocator,
        NullFormatter,
        PercentFormatter,
    )
except ImportError as error:
    raise MissingExtra("drawing figures", "report") from error

__all__ = [
    "Axes",
    "Drawing",
    "Figure",
    "MaxNLocator",
    "PercentFormatter",
    "Sheet",
    "line",
    "logarithmic",
    "save",
    "save_png",
    "styled",
    "svg_of",
]
WIDTH, HEIGHT, COLUMNS = 3.4, 2.7, 3
SPARE = 0.5
DOTS = 150  # of a PNG, for each inch
ENTRY, LETTER = 0.6, 0.075  # inches of a legend's column: its mark, and a letter of its text
STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 5,
    "svg.hashsalt": "sb3-sparse",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
}


def styled() -> AbstractContextManager[None]:
    """Draw in the pages' style within a block; matplotlib's own settings stay as they were."""
    return matplotlib.rc_context(STYLE)


@dataclass(frozen=True)
class Drawing:
    """A figure with the numbers behind it.

    :param figure: the drawing
    :param heads: columns of its CSV
    :param rows: the numbers
    :param remarks: what is missing in it
    """

    figure: Figure
    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]
    remarks: Sequence[str] = field(default_factory=list)


class Sheet:
    """Panels in rows, and the numbers that are drawn in them.

    :param heads: columns of the numbers; those of lines end in x, value, low, high and seeds
    :param count: number of panels
    :param columns: panels in a row
    :param height: height of a row, in inches
    """

    def __init__(
        self, heads: Sequence[str], count: int, columns: int = COLUMNS, height: float = HEIGHT
    ) -> None:
        columns = min(columns, count)
        rows = -(-count // columns)
        size = (max(WIDTH * columns, 4.6), height * rows + 0.5)
        self.figure = Figure(figsize=size, layout="constrained")
        axes = list(self.figure.subplots(rows, columns, squeeze=False).flat)
        for spare in axes[count:]:
            spare.remove()
        self.axes: list[Axes] = axes[:count]
        self.heads, self.rows = heads, list[Sequence[Any]]()

    def line(
        self,
        axes: Axes,
        place: Sequence[Any],
        x: Sequence[float],
        ends: tuple[Array, Array, Array],
        counts: Sequence[int],
        look: Look,
        label: str,
    ) -> None:
        """Draw a line as :func:`line` does, and add its rows.

        :param place: what begins each of the rows
        :param ends: mean, and lower and upper end of the interval, each of the shape of ``x``
        :param counts: what ends each of the rows: the seeds, and the tasks if there are several
        """
        for at, *values in zip(x, *ends, strict=True):
            self.rows.append([*place, at, *map(float, values), *counts])
        line(axes, x, ends, look, label)

    def drawing(self, remarks: Sequence[str] = ()) -> Drawing:
        """Finish the figure with one legend below all panels, and panels as high as their lines."""
        found: dict[str, Any] = {}
        for one in self.axes:
            _limit(one)
            for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
                found.setdefault(label, handle)
        if found:
            entry = ENTRY + LETTER * max(map(len, found))
            columns = max(1, int(self.figure.get_figwidth() / entry))
            self.figure.legend(
                list(found.values()), list(found), loc="outside lower center",
                ncols=min(columns, len(found)),
            )  # fmt: skip
        return Drawing(self.figure, self.heads, self.rows, remarks)


def line(
    axes: Axes, x: Sequence[float], ends: tuple[Array, Array, Array], look: Look, label: str
) -> None:
    """Draw a mean with its interval as a band, or without a band if there is no interval."""
    middle, low, high = ends
    every = max(1, len(x) // 8)
    axes.plot(
        x, middle, color=look.color, linestyle=look.line, marker=look.marker, markevery=every,
        label=label,
    )  # fmt: skip
    if not np.isnan(low).all():
        axes.fill_between(x, low, high, color=look.color, alpha=0.15, linewidth=0)


def _limit(one: Axes) -> None:
    """Show lines whole but cut high bands: one of two seeds reaches 13 standard errors."""
    drawn = [np.asarray(artist.get_ydata(), dtype=np.float64) for artist in one.get_lines()]
    long = [values for values in drawn if not np.array_equal(values, [0, 1])]  # vertical lines
    if not long or one.get_yscale() == "log":
        return
    values = np.concatenate(long)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    spare = SPARE * ((high - low) or abs(high) or 1.0)
    bottom, top = one.get_ylim()
    one.set_ylim(max(bottom, low - spare), min(top, high + spare))


def logarithmic(one: Axes, which: str) -> None:
    """Make an axis logarithmic, with labels over less than a decade, too: 500, 1k, 2k."""
    axis = one.xaxis if which == "x" else one.yaxis
    (one.set_xscale if which == "x" else one.set_yscale)("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
    axis.set_major_formatter(EngFormatter(sep="") if which == "x" else "{x:g}")
    axis.set_minor_formatter(NullFormatter())


def svg_of(figure: Figure) -> bytes:
    """Return a figure as SVG, the same bytes each time."""
    content = io.BytesIO()
    with styled():
        figure.savefig(content, format="svg", metadata={"Date": None})
    return content.getvalue()


def save_png(path: Path, figure: Figure) -> None:
    """Write a figure as PNG; the same bytes each time."""
    with written_whole(path) as new, styled():
        figure.savefig(new, format="png", dpi=DOTS)


def save(name: str, drawing: Drawing, folder: Path) -> None:
    """Write ``<name>.png``, ``<name>.svg`` and ``<name>.csv``; the same bytes each time."""
    folder.mkdir(parents=True, exist_ok=True)
    with written_whole(folder / f"{name}.svg") as new:
        new.write_bytes(svg_of(drawing.figure))
    save_png(folder / f"{name}.png", drawing.figure)
    write_csv(folder / f"{name}.csv", drawing.heads, drawing.rows, digits=8)
