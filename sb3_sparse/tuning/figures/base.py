"""What the figures of a search share: the best trial in colour, all others grey."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_sparse.pages.backend import Axes, Figure, Layout

BEST, GREY, MEAN = "#362682", "#9a9a9a", "#222222"
WIDTH, HEIGHT = 4.8, 3.0  # inches; this width needs no scrolling on a phone
DPI = 144  # of what is drawn as pixels


@dataclass(frozen=True)
class Picture:
    """A figure of the page.

    :param name: its address on the page
    :param title: its heading
    :param caption: what it shows, or why there is none
    :param figure: the drawing; None if there is none
    """

    name: str
    title: str
    caption: str
    figure: Figure | None


def panels(count: int, columns: int = 1, height: float = HEIGHT) -> tuple[Figure, list[Axes]]:
    """Return a figure of the page's width, and its panels, which share the y-axis.

    :param count: number of panels
    :param columns: panels in a row
    :param height: height of a row, in inches
    """
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH, height * rows), dpi=DPI, layout=Layout())
    axes = list(figure.subplots(rows, columns, squeeze=False, sharey=True).flat)
    for spare in axes[count:]:
        spare.remove()
    return figure, axes[:count]
