"""What a figure is, the table of all figures, and how one is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sb3_sparse.errors import ConfigError
from sb3_sparse.files import write_csv
from sb3_sparse.report.backend import (
    Axes,
    EngFormatter,
    Figure,
    LogLocator,
    NullFormatter,
    matplotlib,
)
from sb3_sparse.report.data import Array
from sb3_sparse.report.methods import Look
from sb3_sparse.report.results import Results
from sb3_sparse.report.statistics import Estimate

WIDTH, HEIGHT, COLUMNS = 3.4, 2.7, 3
SPARE = 0.5
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


@dataclass(frozen=True)
class Drawing:
    """A figure with the numbers behind it.

    :param figure: drawn
    :param heads: columns of its CSV
    :param rows: its numbers
    :param remarks: what is not in it
    """

    figure: Figure
    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]
    remarks: Sequence[str] = field(default_factory=list)


Draw = Callable[[Results], Drawing]
DrawT = TypeVar("DrawT", bound=Draw)


@dataclass(frozen=True)
class Entry:
    """A figure's place in the table.

    :param title: its heading
    :param caption: what it shows
    :param draw: draws it
    """

    title: str
    caption: str
    draw: Draw


FIGURES: dict[str, Entry] = {}


def figure(name: str, title: str, caption: str) -> Callable[[DrawT], DrawT]:
    """Enter a figure into the table."""

    def enter(draw: DrawT) -> DrawT:
        FIGURES[name] = Entry(title, caption, draw)
        return draw

    return enter


def check_figures(names: Sequence[str]) -> None:
    """Raise for a name that no figure has.

    :raises ConfigError: and list what is allowed
    """
    unknown = [name for name in names if name not in FIGURES]
    if unknown:
        raise ConfigError(
            f"unknown figure {', '.join(map(repr, unknown))}; allowed are {', '.join(FIGURES)}"
        )


def panels(count: int, columns: int = COLUMNS, height: float = HEIGHT) -> tuple[Figure, list[Axes]]:
    """Axes in rows, as many as are asked for."""
    columns = min(columns, count)
    rows = -(-count // columns)
    made = Figure(figsize=(max(WIDTH * columns, 4.6), height * rows + 0.5), layout="constrained")
    grid = made.subplots(rows, columns, squeeze=False)
    axes = list(grid.flat)
    for spare in axes[count:]:
        spare.remove()
    return made, axes[:count]


def line(
    axes: Axes, x: Sequence[float], ends: tuple[Array, Array, Array], look: Look, label: str
) -> None:
    """A mean with its interval as a band; the band is left out where there is no interval."""
    middle, low, high = ends
    every = max(1, len(x) // 8)
    axes.plot(
        x, middle, color=look.color, linestyle=look.line, marker=look.marker, markevery=every,
        label=label,
    )  # fmt: skip
    if not np.isnan(low).all():
        axes.fill_between(x, low, high, color=look.color, alpha=0.15, linewidth=0)


def estimates_line(
    axes: Axes, x: Sequence[float], estimates: Sequence[Estimate], look: Look, label: str
) -> None:
    """The same of estimates."""
    middle, low, high = (
        np.array([getattr(estimate, end) for estimate in estimates])
        for end in ("value", "low", "high")
    )
    line(axes, x, (middle, low, high), look, label)


def logarithmic(one: Axes, which: str) -> None:
    """A logarithmic axis that is legible over less than a decade, too: 500, 1k, 2k; 0.1, 0.2."""
    axis = one.xaxis if which == "x" else one.yaxis
    (one.set_xscale if which == "x" else one.set_yscale)("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
    axis.set_major_formatter(EngFormatter(sep="") if which == "x" else "{x:g}")
    axis.set_minor_formatter(NullFormatter())


def legend(made: Figure, axes: Sequence[Axes]) -> None:
    """One legend below all panels, each entry once; and the panels' heights by their lines."""
    found: dict[str, Any] = {}
    for one in axes:
        _limit(one)
        for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if found:
        entry = ENTRY + LETTER * max(map(len, found))
        columns = max(1, int(made.get_figwidth() / entry))
        made.legend(
            list(found.values()), list(found), loc="outside lower center",
            ncols=min(columns, len(found)),
        )  # fmt: skip


def _limit(one: Axes) -> None:
    """Show the lines whole; bands of two seeds, which are 13 standard errors high, may be cut."""
    drawn = [np.asarray(artist.get_ydata(), dtype=np.float64) for artist in one.get_lines()]
    long = [values for values in drawn if not np.array_equal(values, [0, 1])]  # vertical lines
    if not long or one.get_yscale() == "log":
        return
    values = np.concatenate(long)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    spare = SPARE * ((high - low) or abs(high) or 1.0)
    bottom, top = one.get_ylim()
    one.set_ylim(max(bottom, low - spare), min(top, high + spare))


def save(name: str, drawing: Drawing, folder: Path) -> None:
    """Write ``<name>.png``, ``<name>.svg`` and ``<name>.csv``; the same bytes each time."""
    folder.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(STYLE):
        drawing.figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        drawing.figure.savefig(folder / f"{name}.png", dpi=150)
    write_csv(folder / f"{name}.csv", drawing.heads, drawing.rows, digits=8)


def draw(name: str, results: Results) -> Drawing:
    """Draw one figure in the house's style.

    :raises NotEnoughData: if these runs do not give it
    """
    with matplotlib.rc_context(STYLE):
        return FIGURES[name].draw(results)
