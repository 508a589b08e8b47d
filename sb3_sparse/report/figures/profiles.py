"""Performance profiles."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_sparse.report.figures.base import Drawing, figure, legend, line, panels
from sb3_sparse.report.methods import look_of, name_of
from sb3_sparse.report.results import Results
from sb3_sparse.report.scores import panels_of
from sb3_sparse.report.statistics import profile

HEADS = ("family", "sparsity", "method", "threshold", "share", "low", "high", "seeds", "tasks")
POINTS, REPS = 61, 1000


@figure(
    "profiles",
    "Performance profiles",
    "Share of runs over all tasks whose normalised score exceeds the threshold, with 95 % "
    "pointwise stratified bootstrap bands (rliable). Higher is better.",
)
def draw(results: Results) -> Drawing:
    """A panel a sparsity, a line a method."""
    found, remarks = panels_of(results)
    made, axes = panels(len(found))
    rows: list[list[Any]] = []
    for one, panel in zip(axes, found, strict=True):
        every = np.concatenate([scores.ravel() for scores in panel.scores.values()])
        pad = 0.05 * (np.ptp(every) or 1.0)
        taus = np.linspace(every.min() - pad, every.max() + pad, POINTS)
        for label, given in panel.scores.items():
            ends = profile(given, taus, REPS)
            line(one, taus.tolist(), ends, look_of(label), name_of(label))
            for tau, *values in zip(taus, *ends, strict=True):
                place: list[Any] = [panel.family, panel.level, label, float(tau)]
                rows.append([*place, *map(float, values), len(given), len(panel.tasks)])
        one.set_title(panel.title)
        one.set_xlabel("normalised score")
        one.set_ylabel("share of runs above")
        one.set_ylim(-0.03, 1.03)
    legend(made, axes)
    return Drawing(made, HEADS, rows, remarks)
