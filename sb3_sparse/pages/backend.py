"""matplotlib, an optional dependency: every module imports it from here."""

from __future__ import annotations

from sb3_sparse.errors import MissingExtra

try:
    import matplotlib
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
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
    "Line2D",
    "LogLocator",
    "MaxNLocator",
    "NullFormatter",
    "NullLocator",
    "Patch",
    "PercentFormatter",
    "matplotlib",
]
