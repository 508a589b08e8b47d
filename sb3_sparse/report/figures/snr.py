"""The signal-to-noise ratio of gradients over training."""

from __future__ import annotations

from sb3_sparse.pages.backend import EngFormatter, MaxNLocator
from sb3_sparse.pages.lines import logarithmic
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import Line, compared, stacked
from sb3_sparse.report.figures.grid import Place
from sb3_sparse.report.measured import SNR, snr_by_network
from sb3_sparse.report.results import NotEnoughData, Results, cell_of

HEADS = ("algorithm and tasks", "environment", "network", "method", "sparsity", "timesteps", "snr",
         "low", "high", "seeds")  # fmt: skip
LEAST = 1e-9  # logarithmic axes have no 0


@figure(
    "snr",
    "Signal-to-noise ratio",
    "Mean over all parameters, active or not, of |mean|/std of the gradients of single samples in "
    "a minibatch, over training: the mean over seeds, from five seeds on with its 95 % Student t "
    "interval, below that with a thin line for each seed. The dense network is grey in every "
    "panel.",
)
def draw(results: Results) -> Drawing:
    """Draw a row for each network, and a panel for each sparsity."""
    found: dict[Place, dict[Line, list[dict[float, float]]]] = {}
    for run in sorted(results.main, key=lambda run: (*cell_of(run), run.seed)):
        for network, points in snr_by_network(run.measured).items():
            lines = found.setdefault(Place(run.family, run.env_id, network), {})
            lines.setdefault((run.label, run.level, ""), []).append(dict(points))
    if not found:
        raise NotEnoughData(f"no run has a {SNR}")
    ordered = dict(sorted(found.items()))
    y = "signal-to-noise ratio"
    grid, panels = compared(HEADS, ordered, x="environment steps", y=y)
    for panel in panels:
        place = panel.place
        for line in panel.lines:
            label, level, _ = line
            steps, values = stacked(found[place][line])
            if steps:
                rows = [place.family, place.env_id, place.part, label, level]
                x = [int(step) for step in steps]
                text, within = panel.text(label), (LEAST, float("inf"))
                grid.curve(panel.axes, rows, x, values, label, text, within)
        logarithmic(panel.axes, "y")
        panel.axes.xaxis.set_major_locator(MaxNLocator(3))
        panel.axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    return grid.drawing()
