"""matplotlib, an optional dependency: every module imports it from here."""

from __future__ import annotations

from sb3_sparse.errors import MissingExtra

try:
    import matplotlib
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import TightLayoutEngine
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import (
        EngFormatter,
        LogLocator,
        MaxNLocator,
        NullFormatter,
        NullLocator,
        PercentFormatter,
    )
except ImportError as error:
    raise MissingExtra("drawing figures", "report") from error

__all__ = [
    "Artist",
    "Axes",
    "EngFormatter",
    "Figure",
    "Layout",
    "Line2D",
    "LogLocator",
    "MaxNLocator",
    "NullFormatter",
    "NullLocator",
    "Patch",
    "PercentFormatter",
    "matplotlib",
]


class Layout(TightLayoutEngine):
    """A layout that puts panels in the same place each time a figure is drawn.

    matplotlib's constrained layout moves them by up to half a point from one process to the
    next, and its tight layout in the last bit, which changes names in an SVG.
    """

    def execute(self, fig: Figure) -> None:
        """Lay out ``fig``, and round what was found."""
        super().execute(fig)
        found = fig.subplotpars
        sides = ("left", "right", "bottom", "top", "wspace", "hspace")
        fig.subplots_adjust(**{side: round(getattr(found, side), 6) for side in sides})
