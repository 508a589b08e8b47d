"""Figures of pages in one style: sheets of panels with one legend; and how they are written."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sb3_sparse.files import write_csv, written_whole
from sb3_sparse.pages.backend import Axes, Figure, Layout, Line2D, Patch, matplotlib
from sb3_sparse.pages.lines import BAND, RUN, SEED, THIN, Ends, heights_of, line
from sb3_sparse.pages.look import Look

WIDTH, HEIGHT, COLUMNS = 3.4, 2.7, 3
NARROWEST = 4.6
SPARE = 0.5
DOTS = 150  # of a PNG, for each inch
ENTRY, LETTER, LINE = 0.6, 0.085, 0.21  # inches: a legend's mark, a letter, a line of text
TEXT, LEAST_GAP = 10, 13  # points
GREY = "#6a6a6a"
STYLE: Any = {
    "font.size": TEXT,
    "axes.titlesize": TEXT,
    "axes.labelsize": TEXT,
    "xtick.labelsize": TEXT,
    "ytick.labelsize": TEXT,
    "legend.fontsize": TEXT,
    "figure.titlesize": 11,
    "figure.titleweight": "bold",
    "figure.labelsize": TEXT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.8,
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
    :param width: width of a column, in inches
    :param title: what all panels have in common
    :param x: the label that all panels share below
    :param y: the label that all panels share at the left
    :param band: what bands are
    """

    def __init__(
        self,
        heads: Sequence[str],
        count: int,
        columns: int = COLUMNS,
        height: float = HEIGHT,
        *,
        width: float = WIDTH,
        title: str = "",
        x: str = "",
        y: str = "",
        band: str = "95 % interval",
    ) -> None:
        self.band = band
        self.columns = min(columns, count)
        rows = -(-count // self.columns)
        size = (max(width * self.columns, NARROWEST), height * rows + LINE * bool(title))
        self.figure = Figure(figsize=size, layout=Layout())
        axes = list(self.figure.subplots(rows, self.columns, squeeze=False).flat)
        for spare in axes[count:]:
            spare.remove()
        self.axes: list[Axes] = axes[:count]
        self.heads, self.rows = heads, list[Sequence[Any]]()
        self.title, self.x, self.y = title, x, y
        self.beside = 0.0  # inches for names at the left of panels that no layout knows of

    def line(
        self,
        axes: Axes,
        place: Sequence[Any],
        x: Sequence[float],
        ends: Ends,
        counts: Sequence[int],
        look: Look,
        label: str,
    ) -> None:
        """Draw a line as :func:`sb3_sparse.pages.lines.line` does, and add its rows.

        :param place: what begins each of the rows
        :param ends: mean, and lower and upper end of the interval, each of the shape of ``x``
        :param counts: what ends each of the rows: the seeds, and the tasks if there are several
        """
        self.note(place, x, ends, counts)
        line(axes, x, ends, look, label)

    def note(
        self, place: Sequence[Any], x: Sequence[Any], ends: Ends, counts: Sequence[int]
    ) -> None:
        """Add the rows of a line."""
        for at, *values in zip(x, *ends, strict=True):
            self.rows.append([*place, at, *map(float, values), *counts])

    def drawing(self, remarks: Sequence[str] = ()) -> Drawing:
        """Finish the figure: its labels, one legend, and panels as high as their lines."""
        for group in _groups(self.axes):
            _limit(group)
        if self.title:
            self.figure.suptitle(self.title, x=0.01, ha="left")
        if self.y:
            self.figure.supylabel(self.y)
        found = (
            {}
            if len(self.axes) == self.columns
            and _label_ends(self.axes[-1], self.figure.get_figheight())
            else self._key()
        )
        entry = ENTRY + LETTER * max(map(len, found), default=0)
        width = self.figure.get_figwidth()
        across = max(1, min(len(found), int(width / entry)))
        strip = LINE * -(-len(found) // across) + 0.06 * bool(found)
        below = strip + LINE * bool(self.x)
        if below or self.beside:
            height = self.figure.get_figheight() + below
            self.figure.set_figheight(height)
            engine: Any = self.figure.get_layout_engine()
            engine.set(rect=(self.beside / width, below / height, 1, 1))
            if self.x:
                text = self.figure.supxlabel(self.x, y=(strip + 0.02) / height, va="bottom")
                text.set_in_layout(False)  # a layout would part it from the panels
        if found:
            self.figure.legend(
                list(found.values()), list(found), loc="lower center", bbox_to_anchor=(0.5, 0),
                ncols=across, borderaxespad=0.1, borderpad=0.1, columnspacing=1.5,
            )  # fmt: skip
        return Drawing(self.figure, self.heads, self.rows, remarks)

    def _key(self) -> dict[str, Any]:
        """Return what the legend shows: the labelled lines, and what thin lines and bands are."""
        found: dict[str, Any] = {}
        marks = set()
        for one in self.axes:
            for handle, label in zip(*one.get_legend_handles_labels(), strict=True):
                found.setdefault(label, handle)
            for artist in one.get_children():
                if artist.get_gid() in (SEED, RUN, BAND):
                    dotted = isinstance(artist, Line2D) and artist.get_linestyle() == "None"
                    marks.add((artist.get_gid(), dotted))
        for each in (SEED, RUN):
            kinds = {dotted for mark, dotted in marks if mark == each}
            if kinds:
                found[f"one {each}"] = Line2D(
                    [], [], color=GREY, linewidth=THIN, alpha=0.9, markersize=3.8,
                    linestyle="-" if False in kinds else "", marker="o" if True in kinds else "",
                )  # fmt: skip
        if (BAND, False) in marks:
            found[self.band] = Patch(color=GREY, alpha=0.25, linewidth=0)
        return found


def _groups(axes: Iterable[Axes]) -> list[list[Axes]]:
    """Group panels that share their y axis."""
    found: list[list[Axes]] = []
    for one in axes:
        if not any(one in group for group in found):
            found.append(list(one.get_shared_y_axes().get_siblings(one)))
    return found


def _limit(group: Sequence[Axes]) -> None:
    """Show lines whole but cut high bands of panels that share their y axis."""
    one = group[0]
    values = np.concatenate([heights_of(axes) for axes in group])
    if not len(values) or one.get_yscale() == "log" or not one.get_autoscaley_on():
        return
    low, high = float(values.min()), float(values.max())
    spare = SPARE * ((high - low) or abs(high) or 1.0)
    bottom, top = one.get_ylim()
    one.set_ylim(max(bottom, low - spare), min(top, high + spare))


def _label_ends(one: Axes, high: float) -> bool:
    """Write the names of lines at their ends if they stand far enough apart; else do nothing.

    :param high: height of the figure, in inches
    """
    ends = []
    for artist in one.get_lines():
        x, y = (np.asarray(values, dtype=np.float64) for values in artist.get_data())
        label = str(artist.get_label())
        if not label.startswith("_") and len(x):
            last = int(np.argmax(x))
            ends.append((label, x[last], y[last], artist.get_color()))
    if len(ends) < 2:
        return False
    points_high = 72 * (one.get_position().height * high)
    shown = [one.transAxes.inverted().transform(one.transData.transform((x, y)))
             for _, x, y, _ in ends]  # fmt: skip
    heights = sorted(points_high * y for _, y in shown)
    if np.diff(heights).min() < LEAST_GAP or np.ptp([x for x, _ in shown]) > 0.02:
        return False
    for label, x, y, color in ends:
        one.annotate(
            label, (x, y), xytext=(7, 0), textcoords="offset points", va="center",
            color=[0.7 * part for part in matplotlib.colors.to_rgb(color)], annotation_clip=False,
        )  # fmt: skip
    return True


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
    drawing.figure.set_layout_engine(None)  # its panels stay where the SVG has them
    save_png(folder / f"{name}.png", drawing.figure)
    write_csv(folder / f"{name}.csv", drawing.heads, drawing.rows, digits=8)
