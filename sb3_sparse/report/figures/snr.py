"""The signal-to-noise ratio of gradients over training."""

from __future__ import annotations

from collections import defaultdict

from sb3_sparse.pages.plot import Drawing, logarithmic
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.measured import SNR, Points, snr_by_network
from sb3_sparse.report.methods import DENSE, name_of, percent, shaded
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import means_at

HEADS = ("family", "environment", "network", "method", "sparsity", "timesteps", "snr", "low",
         "high", "seeds")  # fmt: skip


@figure(
    "snr",
    "Signal-to-noise ratio",
    "Mean over all parameters, active or not, of |mean|/std of the gradients of single samples in "
    "a minibatch, over training, with 95 % Student t intervals over seeds; a panel for each "
    "network, a colour for each sparsity, a marker and line style for each method.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each network, with a line for each method and sparsity."""
    found: dict[tuple[str, str, str], dict[tuple[str, float], list[Points]]] = {}
    for run in results.main:
        for network, points in snr_by_network(run.measured).items():
            lines = found.setdefault((run.family, run.env_id, network), defaultdict(list))
            lines[run.label, run.level].append(points)
    if not found:
        raise NotEnoughData(f"no run has a {SNR}")
    sheet = Sheet(HEADS, len(found), height=3.0)
    levels = sorted({level for lines in found.values() for _, level in lines})
    panels = zip(sheet.axes, sorted(found.items()), strict=True)
    for one, ((family, env_id, network), lines) in panels:
        for (label, level), seeds in sorted(lines.items(), key=lambda item: item[0][::-1]):
            steps, ends = means_at([dict(points) for points in seeds])
            if not steps:
                continue
            look = shaded(label, levels.index(level))
            text = name_of(label) if label == DENSE else f"{name_of(label)}, {percent(level)}"
            place = [family, env_id, network, label, level]
            sheet.line(one, place, list(map(int, steps)), ends, [len(seeds)], look, text)
        logarithmic(one, "y")
        title = f"{family}\n{env_id}, {network}"
        one.set(title=title, xlabel="environment steps", ylabel="SNR")
    return sheet.drawing()
