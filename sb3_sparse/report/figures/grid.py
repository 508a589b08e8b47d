"""Grids of panels that are compared: a row for each task, a column for each sparsity or method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sb3_sparse.intervals import mean_interval
from sb3_sparse.pages.backend import Axes
from sb3_sparse.pages.lines import ANY, Within, curve, points
from sb3_sparse.pages.numbers import counted_between
from sb3_sparse.pages.plot import LINE, Drawing, Sheet
from sb3_sparse.report.data import Array
from sb3_sparse.report.methods import look_of

MOST_FLOWING = 3
WIDTHS = {1: 4.6, 2: 3.8, 3: 3.2, 4: 2.6, 5: 2.25}
NARROW, HIGH, LOW, LEAST = 2.05, 2.3, 1.5, 1.0
BETWEEN = -0.08  # the share of a panel's height at which the gap to the next row has its middle
ROOM = 9.2  # inches for all rows, so that a figure fits a screen


@dataclass(frozen=True, order=True)
class Place:
    """What a group of panels is about; they share their axes.

    :param family: algorithm and tasks
    :param env_id: the task; empty for all
    :param part: what of it, e.g. a network; empty for all
    """

    family: str
    env_id: str = ""
    part: str = ""


@dataclass(frozen=True)
class Row:
    """A row of panels.

    :param place: what it is about
    :param name: by what it differs from other rows of its place; empty if there are none
    """

    place: Place
    name: str = ""


class Grid(Sheet):
    """Panels in rows and columns, with shared axes, and what they have in common said once.

    A single column is laid out as a row of panels.

    :param heads: columns of the numbers
    :param rows: the rows; those of a place stand together
    :param columns: the columns' names
    :param x: the label below
    :param y: the label at the left
    :param height: height of a row, in inches; None for one with which rows fit a screen
    :param above: points that ticks above panels take
    """

    def __init__(
        self,
        heads: Sequence[str],
        rows: Sequence[Row],
        columns: Sequence[str],
        *,
        x: str,
        y: str,
        height: float | None = None,
        above: float = 0.0,
    ) -> None:
        places = list(dict.fromkeys(row.place for row in rows))
        title, self.texts = _titles(places)
        self.flowing = len(columns) == 1 and len(rows) == len(places) > 1
        across = min(len(rows), MOST_FLOWING) if self.flowing else len(columns)
        usual = LOW if len(rows) > len(places) else HIGH
        down = -(-len(rows) // across) if self.flowing else len(rows)
        fitting = max(LEAST, min(usual, ROOM / down - above / 72))
        super().__init__(
            heads, len(rows) * len(columns), across, (height or fitting) + above / 72,
            width=WIDTHS.get(across, NARROW), title=title, x=x, y=y,
        )  # fmt: skip
        self.lines_of = list(rows)
        self.names, self.above = list(columns), above
        self.counts: set[int] = set()
        self.remarks: list[str] = []
        self.noted: set[Any] = set()
        for place in places:
            first, *others = self.group(place)
            for one in others:
                one.sharex(first)
                one.sharey(first)

    def at(self, row: int, column: int) -> Axes:
        """Return a panel."""
        return self.axes[row * len(self.names) + column]

    def group(self, place: Place) -> list[Axes]:
        """Return the panels of a place."""
        across = range(len(self.names))
        return [
            self.at(i, j) for i, row in enumerate(self.lines_of) if row.place == place
            for j in across
        ]  # fmt: skip

    def _name(self, place: Place) -> None:
        """Name a place at the left of its rows: once, in the middle, if rows have names too."""
        rows = [i for i, row in enumerate(self.lines_of) if row.place == place]
        text = _broken(self.texts[place])
        for i in rows:
            self.at(i, 0).set_ylabel(_broken(self.lines_of[i].name) or text)
        if self.lines_of[rows[0]].name and text:
            middle = self.at(rows[(len(rows) - 1) // 2], 0)
            height = BETWEEN if len(rows) % 2 == 0 else 0.5
            name = middle.annotate(
                text, (0, height), (-5, 0), textcoords="offset points",
                xycoords=(middle.yaxis.label, middle.transAxes), ha="right", va="center",
                ma="center", rotation=90, weight="bold", annotation_clip=False,
            )  # fmt: skip
            name.set_in_layout(False)  # it is longer than its panel, and must not part the rows
            self.beside = max(self.beside, LINE * (1 + text.count("\n")))

    def curve(
        self, one: Axes, place: Sequence[Any], x: Sequence[float], seeds: Array, label: str,
        text: str, within: Within = ANY,
    ) -> None:  # fmt: skip
        """Draw a curve over seeds, and add its rows; those of a line in several panels once.

        :param place: what begins each of the rows
        :param seeds: shape ``[seeds, n]``
        :param label: the method
        :param text: text of the legend
        """
        self.note_once(place, x, seeds.T)
        curve(one, x, seeds, look_of(label), text, within)

    def points(
        self, one: Axes, place: Sequence[Any], x: Sequence[float],
        scores: Sequence[Sequence[float]], label: str, text: str, within: Within = ANY,
        names: Sequence[Any] = (),
    ) -> None:  # fmt: skip
        """Draw points over seeds, joined, and add their rows, as :meth:`curve` does.

        :param scores: the scores of the seeds at each point
        :param names: what stands for ``x`` in the rows
        """
        self.note_once(place, names or x, scores)
        points(one, x, scores, look_of(label), text, within)

    def note_once(
        self, place: Sequence[Any], x: Sequence[Any], scores: Sequence[Sequence[float]] | Array
    ) -> None:
        """Add the rows of a line: at each ``x`` mean, interval and number of seeds."""
        self.counts |= {len(values) for values in scores}
        key = repr((place, x))
        if key not in self.noted:
            self.noted.add(key)
            for at, values in zip(x, scores, strict=True):
                ends = map(float, mean_interval(values))
                self.rows.append([*place, at, *ends, len(values)])

    def drawing(self, remarks: Sequence[str] = ()) -> Drawing:
        """Finish the figure: names of rows and columns, and ticks at the outside alone."""
        rows, columns = len(self.lines_of), len(self.names)
        remarks = [*self.remarks, *remarks]
        if self.counts:
            seeds = counted_between(self.counts, "seed")
            self.title = ", ".join(text for text in (self.title, seeds) if text)
        if self.flowing:
            for one, row in zip(self.axes, self.lines_of, strict=True):
                one.set_title(_broken(self.texts[row.place]))
            return super().drawing(remarks)
        for j, name in enumerate(self.names):
            self.at(0, j).set_title(_broken(name))
        last = {row.place: i for i, row in enumerate(self.lines_of)}
        same = len({self.at(i, 0).get_xlim() for i in last.values()}) == 1
        for place in last:
            self._name(place)
        self.figure.align_ylabels([self.at(i, 0) for i in range(rows)])
        for i, row in enumerate(self.lines_of):
            ends = i == rows - 1 or (i == last[row.place] and not same)
            for j in range(columns):
                self.at(i, j).tick_params(labelbottom=ends, labelleft=j == 0)
        return super().drawing(remarks)


def _titles(places: Sequence[Place]) -> tuple[str, dict[Place, str]]:
    """Return what all places have in common, and what is left to say of each."""
    families = {place.family for place in places}
    texts = {
        place: ", ".join(text for text in (place.env_id, place.part) if text) for place in places
    }
    if len(families) > 1:
        return "", {
            place: f"{place.family.rsplit(' on ', 1)[0]}: {text}" if text else place.family
            for place, text in texts.items()
        }
    (family,) = families
    if len(places) > 1 or not texts[places[0]]:
        return family, texts
    return f"{family.rsplit(' on ', 1)[0]} on {texts[places[0]]}", {places[0]: ""}


def _broken(name: str) -> str:
    """Break a long name at its comma or colon."""
    return name.replace(", ", ",\n").replace(": ", ":\n")
