"""The interquartile mean of each method."""

from __future__ import annotations

from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.methods import look_of, name_of
from sb3_sparse.report.results import Results
from sb3_sparse.report.scores import panels_of
from sb3_sparse.report.statistics import iqm_estimates

HEADS = ("family", "sparsity", "method", "iqm", "low", "high", "seeds", "tasks")


@figure(
    "iqm",
    "Interquartile mean",
    "Mean of the middle half of normalised scores over runs and tasks, with 95 % stratified "
    "bootstrap intervals (rliable); a panel for each sparsity.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each sparsity, with an interval for each method."""
    found, remarks = panels_of(results)
    sheet = Sheet(HEADS, len(found))
    for one, panel in zip(sheet.axes, found, strict=True):
        estimates = iqm_estimates(panel.scores)
        for place, (label, estimate) in enumerate(estimates.items()):
            look = look_of(label)
            ends = [estimate.low, estimate.high]
            one.plot(ends, [place, place], color=look.color, linewidth=9, alpha=0.35,
                     solid_capstyle="butt")  # fmt: skip
            one.plot(estimate.value, place, look.marker, color=look.color, markersize=7)
            low, high, value = estimate.low, estimate.high, estimate.value
            row = [panel.family, panel.level, label, value, low, high]
            sheet.rows.append([*row, estimate.seeds, estimate.tasks])
        one.set_yticks(range(len(estimates)), [name_of(label) for label in estimates])
        one.invert_yaxis()
        one.margins(x=0.08, y=0.12)
        one.set(title=panel.title, xlabel="IQM of normalised scores")
    return sheet.drawing(remarks)
