"""Learning curves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from sb3_sparse.pages.backend import EngFormatter, MaxNLocator
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.data import Array, RunData
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import Line, compared
from sb3_sparse.report.figures.grid import Place
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import NotEnoughData, Results, cell_of

HEADS = ("algorithm and tasks", "environment", "sparsity", "method", "timesteps", "mean", "low",
         "high", "seeds")  # fmt: skip


@figure(
    "curves",
    "Learning curves",
    "Return of the evaluations during training: the mean over seeds, from five seeds on with its "
    "pointwise 95 % Student t interval, which ends at the returns that are possible; below five "
    "seeds each seed is a thin line. The dense network of full size is grey in every panel.",
)
def draw(results: Results) -> Drawing:
    """Draw a row for each environment, and a panel for each sparsity, or method and sparsity."""
    found: dict[Place, dict[Line, list[RunData]]] = {}
    for run in sorted(results.main, key=lambda run: (*cell_of(run), run.seed)):
        lines = found.setdefault(Place(run.family, run.env_id), {})
        lines.setdefault((run.label, run.level, ""), []).append(run)
    if not found:
        raise NotEnoughData("there is no trained run")
    grid, panels = compared(HEADS, found, x="environment steps", y="mean return")
    remarks: list[str] = []
    for panel in panels:
        place, one = panel.place, panel.axes
        for line in panel.lines:
            label, level, _ = line
            steps, values, said = aligned(found[place][line])
            remarks += said
            x = [int(step) for step in steps]
            rows = [place.family, place.env_id, level, label]
            within = possible_returns(place.env_id)
            grid.curve(one, rows, x, values, label, panel.text(label), within)
        one.xaxis.set_major_locator(MaxNLocator(3))
        one.xaxis.set_major_formatter(EngFormatter(sep=""))
    return grid.drawing(list(dict.fromkeys(remarks)))


def aligned(runs: Sequence[RunData]) -> tuple[Array, Array, list[str]]:
    """Return the curves of the runs that were evaluated at the most common steps.

    :return: steps ``[T]``, returns ``[seeds, T]``, and remarks on runs evaluated at other steps
    """
    counts = Counter(run.timesteps.tobytes() for run in runs)
    common = max(counts, key=lambda steps: (counts[steps], len(steps), steps))
    same = [run for run in runs if run.timesteps.tobytes() == common]
    remarks = [
        f"{run.folder}: evaluated at other steps ({len(run.timesteps)} evaluations instead of "
        f"{len(same[0].timesteps)}), so its curve is not averaged with the others; its score is"
        for run in runs
        if run.timesteps.tobytes() != common
    ]
    return same[0].timesteps, np.stack([run.returns for run in same]), remarks
