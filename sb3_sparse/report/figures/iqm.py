"""The interquartile mean of each method."""

from __future__ import annotations

from sb3_sparse.pages.lines import RUN
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.intervals import by_sparsity, estimate
from sb3_sparse.report.methods import in_order, look_of, name_of
from sb3_sparse.report.results import Results
from sb3_sparse.report.scores import panels_of
from sb3_sparse.report.statistics import iqm_estimates

HEADS = ("algorithm and tasks", "sparsity", "method", "iqm", "low", "high", "seeds", "tasks")


@figure(
    "iqm",
    "Interquartile mean",
    "Mean of the middle half of the normalised scores of all runs, over tasks and seeds: from five "
    "seeds on with its 95 % stratified bootstrap interval (rliable), below that with a small dot "
    "for each run.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each sparsity, with an estimate for each method."""
    found, remarks = panels_of(results)
    labels = in_order({label for panel in found for label in panel.scores})
    grid, axes = by_sparsity(HEADS, found, len(labels), "IQM of normalised scores")
    for one, panel in zip(axes, found, strict=True):
        for label, given in iqm_estimates(panel.scores).items():
            runs = sorted(panel.scores[label].ravel().tolist())
            estimate(one, labels.index(label), given, runs, look_of(label), RUN)
            row = [panel.family, panel.level, label, given.value, given.low, given.high]
            grid.rows.append([*row, given.seeds, given.tasks])
        one.set_yticks(range(len(labels)), [name_of(label) for label in labels])
        one.set_ylim(len(labels) - 0.4, -0.6)
    return grid.drawing(remarks)
