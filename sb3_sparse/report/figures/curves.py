"""Learning curves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from sb3_sparse.intervals import mean_interval
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.data import Array, RunData
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.methods import DENSE, look_of, name_of, percent
from sb3_sparse.report.results import NotEnoughData, Results

HEADS = ("family", "environment", "sparsity", "method", "timesteps", "mean", "low", "high", "seeds")


@figure(
    "curves",
    "Learning curves",
    "Mean return of the evaluations during training over seeds, with pointwise 95 % Student t "
    "intervals (no band for one seed); a panel for each environment and sparsity.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each environment and sparsity, with a line for each method."""
    places = [
        (family, env_id, level)
        for family in results.families()
        for env_id in results.envs(family)
        for level in results.levels(family) or [0.0]
        if any(
            results.cell(family, env_id, label, level)
            for label in results.labels(family, level)
            if label != DENSE or not results.levels(family)
        )
    ]
    if not places:
        raise NotEnoughData("there is no trained run")
    sheet = Sheet(HEADS, len(places))
    remarks: list[str] = []
    for one, (family, env_id, level) in zip(sheet.axes, places, strict=True):
        for label in results.labels(family, level):
            runs = results.cell(family, env_id, label, level)
            if not runs:
                continue
            steps, values, said = aligned(runs)
            remarks += said
            place = [family, env_id, 0.0 if label == DENSE else level, label]
            sheet.line(
                one,
                place,
                [int(step) for step in steps],
                mean_interval(values),
                [len(values)],
                look_of(label),
                name_of(label),
            )
        one.set(
            title=f"{family}\n{env_id}, {percent(level)}",
            xlabel="environment steps",
            ylabel="mean return",
        )
        one.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
    return sheet.drawing(list(dict.fromkeys(remarks)))


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
