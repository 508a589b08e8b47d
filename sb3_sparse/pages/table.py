"""Tables, for pages and for CSV files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class Cell:
    """An entry that does not show its value with the table's digits.

    :param value: what a page sorts by
    :param text: what it shows
    :param strong: whether it stands out
    """

    value: float
    text: str
    strong: bool = False


@dataclass(frozen=True)
class Table:
    """Named columns and their rows.

    :param heads: names of the columns
    :param rows: an entry for each column: a text, a number or a :class:`Cell`; None is an empty
        cell
    :param digits: significant digits of floats on a page
    :param marks: ``"good"``, ``"bad"`` or ``"open"`` by the text of a cell, for cells that a page
        marks
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]
    digits: int = 2
    marks: Mapping[str, str] = field(default_factory=dict)

    def varying(self, *keep: str) -> tuple[Table, dict[str, Any]]:
        """Return the table without the columns whose entries are all equal, and what these hold.

        A table of one row keeps its columns, except empty ones. What is said to be held leaves out
        empty columns.

        :param keep: heads of columns that stay
        """
        columns = list(zip(*self.rows, strict=True))
        same = {
            place: column[0]
            for place, column in enumerate(columns)
            if self.heads[place] not in keep
            and (len(column) > 1 or column[0] is None)
            and all(entry == column[0] for entry in column)
        }
        kept = [place for place in range(len(self.heads)) if place not in same]
        rows = [[row[place] for place in kept] for row in self.rows]
        table = replace(self, heads=[self.heads[place] for place in kept], rows=rows)
        return table, {self.heads[p]: value for p, value in same.items() if value is not None}
