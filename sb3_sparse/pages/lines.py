"""Lines over seeds: from five seeds on a mean with a band, below that a mean and every seed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_sparse.intervals import Array, mean_interval
from sb3_sparse.pages.backend import Axes, EngFormatter, LogLocator, NullFormatter
from sb3_sparse.pages.look import Look

Ends = tuple[Array, Array, Array]
"""Mean, and lower and upper end of its interval, each of shape ``[n]``."""
Within = tuple[float, float]
"""The least and the greatest value that is possible."""
SUBS = ((1.0, (1.0, 2.0, 5.0)), (2.2, (1.0, 3.0)), (math.inf, (1.0,)))  # ticks by decades
TWO_LABELS = 5.5  # a range of this factor has two of 1, 2, 5, 10, ..
ANY: Within = (-math.inf, math.inf)
LEAST_FOR_BAND = 5
SEED, RUN, BAND = "seed", "run", "band"  # mark what belongs to a line, for the legend
THIN, BOLD, FAINT = 0.8, 1.8, 0.5
BAR = 6.0  # points
MARKS = 4


def curve(
    axes: Axes, x: Sequence[float], seeds: Array, look: Look, label: str, within: Within = ANY
) -> None:
    """Draw a mean curve: with a band from five seeds on, or with a thin curve for each seed.

    :param seeds: a row for each seed, shape ``[seeds, n]``
    :param label: text of the legend; empty for none
    :param within: bands are cut at these values
    """
    if len(seeds) < LEAST_FOR_BAND and len(seeds) > 1:
        for one in seeds:
            axes.plot(x, one, color=look.color, linewidth=THIN, alpha=FAINT, gid=SEED)
    line(axes, x, shown(mean_interval(seeds), [len(seeds)] * len(x), within), look, label)


def points(
    axes: Axes,
    x: Sequence[float],
    scores: Sequence[Sequence[float]],
    look: Look,
    label: str,
    within: Within = ANY,
) -> None:
    """Draw a mean at each of several points, joined, with a band from five seeds on.

    Where there are fewer, each seed is a small dot.

    :param scores: the scores of the seeds at each point
    :param label: text of the legend; empty for none
    :param within: bands are cut at these values
    """
    for at, values in zip(x, scores, strict=True):
        if 1 < len(values) < LEAST_FOR_BAND:
            dots(axes, [at] * len(values), values, look)
    ends = np.array([mean_interval(values) for values in scores], dtype=np.float64).T
    line(axes, x, shown((ends[0], ends[1], ends[2]), list(map(len, scores)), within), look, label)


def dots(axes: Axes, x: Sequence[float], y: Sequence[float], look: Look, each: str = SEED) -> None:
    """Draw small dots.

    :param each: what a dot is, a seed or a run
    """
    axes.plot(
        x, y, linestyle="", marker="o", markersize=3.8, color=look.color, alpha=FAINT,
        markeredgewidth=0, gid=each,
    )  # fmt: skip


def shown(ends: Ends, counts: Sequence[int], within: Within = ANY) -> Ends:
    """Return what of intervals is drawn: none below five seeds, and nothing that is impossible."""
    middle, low, high = ends
    few = np.asarray(counts) < LEAST_FOR_BAND
    return (
        middle,
        np.where(few, np.nan, np.clip(low, *within)),
        np.where(few, np.nan, np.clip(high, *within)),
    )


def line(axes: Axes, x: Sequence[float], ends: Ends, look: Look, label: str) -> None:
    """Draw a mean with its intervals as a band, and as a bar where a point stands alone.

    :param label: text of the legend; empty for none
    """
    middle, low, high = ends
    axes.plot(
        x, middle, color=look.color, linestyle=look.line, marker=look.marker, linewidth=BOLD,
        markevery=max(1, round(len(x) / MARKS)) if len(x) > 2 * MARKS else 1, label=label or None,
    )  # fmt: skip
    known = ~np.isnan(low)
    if known.any():
        axes.fill_between(x, low, high, color=look.color, alpha=0.18, linewidth=0, gid=BAND)
        padded = np.pad(known, 1)
        alone = known & ~padded[:-2] & ~padded[2:]  # a band has no area there
        if alone.any():
            axes.vlines(
                np.asarray(x)[alone], low[alone], high[alone], color=look.color, linewidth=BAR,
                alpha=0.3, gid=BAND,
            )  # fmt: skip


def logarithmic(one: Axes, which: str) -> None:
    """Make an axis logarithmic, with labels over less than a decade, too: 500, 1k, 2k.

    Call it when all lines are drawn: a short x axis becomes long enough for two labels.
    """
    axis = one.xaxis if which == "x" else one.yaxis
    (one.set_xscale if which == "x" else one.set_yscale)("log")
    low, high = one.get_xlim() if which == "x" else one.get_ylim()
    if which == "x" and high < TWO_LABELS * low:
        middle = math.sqrt(low * high)
        low, high = middle / math.sqrt(TWO_LABELS), middle * math.sqrt(TWO_LABELS)
        one.set_xlim(low, high)
    subs = next(subs for decades, subs in SUBS if high <= low * 10**decades)
    axis.set_major_locator(LogLocator(subs=subs, numticks=6))
    axis.set_major_formatter(EngFormatter(sep="") if which == "x" else "{x:g}")
    axis.set_minor_formatter(NullFormatter())


def heights_of(axes: Axes) -> Array:
    """Return all y that lines reach, those of vertical lines left out."""
    drawn: list[Any] = [
        artist.get_ydata()
        for artist in axes.get_lines()
        if artist.get_transform().contains_branch_seperately(axes.transData)[1]
    ]
    values: Array = np.array(
        [value for y in drawn for value in np.asarray(y, dtype=np.float64).ravel()]
    )
    return values[np.isfinite(values)]
