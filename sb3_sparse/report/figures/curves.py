"""Learning curves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_sparse.intervals import mean_interval
from sb3_sparse.report.data import Array, RunData
from sb3_sparse.report.figures.base import Drawing, figure, legend, line, panels
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
    """A panel for each environment and sparsity, a line a method."""
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
    made, axes = panels(len(places))
    rows: list[list[Any]] = []
    remarks: list[str] = []
    for one, (family, env_id, level) in zip(axes, places, strict=True):
        for label in results.labels(family, level):
            runs = results.cell(family, env_id, label, level)
            if not runs:
                continue
            steps, values, said = aligned(runs)
            remarks += said
            ends = mean_interval(values)
            line(one, steps.tolist(), ends, look_of(label), name_of(label))
            shown = 0.0 if label == DENSE else level
            for step, *three in zip(steps, *ends, strict=True):
                place: list[Any] = [family, env_id, shown, label, int(step)]
                rows.append([*place, *map(float, three), len(values)])
        one.set_title(f"{family}\n{env_id}, {percent(level)}")
        one.set_xlabel("environment steps")
        one.set_ylabel("mean return")
        one.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
    legend(made, axes)
    return Drawing(made, HEADS, rows, list(dict.fromkeys(remarks)))


def aligned(runs: Sequence[RunData]) -> tuple[Array, Array, list[str]]:
    """Curves of the runs that were evaluated at the steps that most of them share.

    :return: steps ``[T]``, returns ``[seeds, T]``, and the names of runs evaluated at others
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
