"""Performance profiles."""

from __future__ import annotations

import numpy as np

from sb3_sparse.pages.lines import line as drawn_line
from sb3_sparse.pages.lines import shown
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import Line, compared
from sb3_sparse.report.figures.grid import Place
from sb3_sparse.report.methods import DENSE, look_of
from sb3_sparse.report.results import Results
from sb3_sparse.report.scores import panels_of
from sb3_sparse.report.statistics import profile

HEADS = ("algorithm and tasks", "sparsity", "method", "threshold", "share", "low", "high", "seeds",
         "tasks")  # fmt: skip
POINTS, REPS = 61, 1000


@figure(
    "profiles",
    "Performance profiles",
    "Share of all runs, over tasks and seeds, whose normalised score exceeds the threshold, from "
    "five seeds on with 95 % pointwise stratified bootstrap bands (rliable). Higher is better. The "
    "dense network of full size is grey in every panel.",
)
def draw(results: Results) -> Drawing:
    """Draw a column for each sparsity, and a row for each method if there are many."""
    found, remarks = panels_of(results)
    lines: dict[Place, dict[Line, None]] = {}
    scores, tasks = {}, {}
    for given in found:
        place = Place(given.family)
        tasks[given.family, given.level] = len(given.tasks)
        for label, values in given.scores.items():
            level = 0.0 if label == DENSE else given.level
            lines.setdefault(place, {})[label, level, ""] = None
            scores[given.family, given.level, label] = values
    grid, panels = compared(
        HEADS, lines, x="normalised score", y="share of runs above", methods_across=False
    )
    for panel in panels:
        family = panel.place.family
        here = [values for (one, *_), values in scores.items() if one == family]
        every = np.concatenate([values.ravel() for values in here])
        pad = 0.05 * (np.ptp(every) or 1.0)
        taus = np.linspace(every.min() - pad, every.max() + pad, POINTS)
        for label, _, _ in panel.lines:
            if (family, panel.level, label) not in scores:
                continue
            values = scores[family, panel.level, label]
            ends = profile(values, taus, REPS)
            counts = [len(values), tasks[family, panel.level]]
            grid.counts.add(len(values))
            rows = [family, panel.level, label]
            if (key := repr(rows)) not in grid.noted:
                grid.noted.add(key)
                grid.note(rows, taus.tolist(), ends, counts)
            drawn = shown(ends, [len(values)] * len(taus))
            drawn_line(panel.axes, taus.tolist(), drawn, look_of(label), panel.text(label))
        panel.axes.set_ylim(-0.07, 1.07)
    many = " to ".join(map(str, sorted({*tasks.values()})))
    grid.title = f"{grid.title}, {many} task{'s' * (many != '1')}".removeprefix(", ")
    return grid.drawing(remarks)
