"""Tables, for pages and for CSV files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
    digits: int = 4
    marks: Mapping[str, str] = field(default_factory=dict)
