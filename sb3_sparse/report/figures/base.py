"""Figures: their registry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from sb3_sparse.errors import check_choice
from sb3_sparse.pages.plot import Drawing, styled
from sb3_sparse.report.results import Results

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
"""Every figure by its name, as studies and :func:`sb3_sparse.report.write_report` take it."""


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


def draw(name: str, results: Results) -> Drawing:
    """Draw a figure in the pages' style.

    :raises NotEnoughData: if these runs are not enough for it
    """
    with styled():
        return FIGURES[name].draw(results)
