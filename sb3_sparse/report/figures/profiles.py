"""Performance profiles."""

from __future__ import annotations

import numpy as np

from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import Sheet, figure
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
    """Draw a panel for each sparsity, with a line for each method."""
    found, remarks = panels_of(results)
    sheet = Sheet(HEADS, len(found))
    for one, panel in zip(sheet.axes, found, strict=True):
        every = np.concatenate([scores.ravel() for scores in panel.scores.values()])
        pad = 0.05 * (np.ptp(every) or 1.0)
        taus = np.linspace(every.min() - pad, every.max() + pad, POINTS)
        for label, given in panel.scores.items():
            sheet.line(
                one,
                [panel.family, panel.level, label],
                taus.tolist(),
                profile(given, taus, REPS),
                [len(given), len(panel.tasks)],
                look_of(label),
                name_of(label),
            )
        one.set(title=panel.title, xlabel="normalised score", ylabel="share of runs above")
        one.set_ylim(-0.03, 1.03)
    return sheet.drawing(remarks)
