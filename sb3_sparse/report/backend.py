"""rliable and matplotlib, optional dependencies: every module imports them from here."""

from __future__ import annotations

from sb3_sparse.errors import MissingExtra

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
    from rliable import library as rliable_library
except ImportError as error:
    raise MissingExtra("reports on runs", "report") from error

__all__ = [
    "Axes",
    "EngFormatter",
    "Figure",
    "LogLocator",
    "MaxNLocator",
    "NullFormatter",
    "PercentFormatter",
    "matplotlib",
    "rliable_library",
]
