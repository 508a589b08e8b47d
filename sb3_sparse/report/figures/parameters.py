"""Final reward against parameter count."""

from __future__ import annotations

from statistics import fmean
from typing import Any

import numpy as np

from sb3_sparse.report.backend import Axes
from sb3_sparse.report.figures.base import (
    Drawing,
    estimates_line,
    figure,
    legend,
    logarithmic,
    panels,
)
from sb3_sparse.report.methods import DENSE, EQUAL, in_order, look_of, name_of, percent
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import mean

HEADS = ("family", "environment", "method", "sparsity", "parameters", "mean score", "low", "high",
         "seeds")  # fmt: skip
MARKED = (0.8, 0.9)


@figure(
    "parameters",
    "Final reward against parameter count",
    "Mean score (the last 10 % of evaluations) against active parameters on a logarithmic axis, "
    "with 95 % Student t intervals (none for one seed); sparsities are written along one curve. "
    "The horizontal line is the dense network of full size, the vertical one marks 80 % sparsity "
    "(90 % where no run has 80 %).",
)
def draw(results: Results) -> Drawing:
    """A panel an environment, a line a method."""
    places = [
        (family, env_id)
        for family in results.families()
        for env_id in results.envs(family)
        if any(
            results.cell(family, env_id, label, level)
            for level in results.levels(family)
            for label in results.labels(family, level)
            if label != DENSE
        )
    ]
    if not places:
        raise NotEnoughData("there is no trained run but dense ones of full size")
    made, axes = panels(len(places), columns=3, height=3.2)
    rows: list[list[Any]] = []
    for one, (family, env_id) in zip(axes, places, strict=True):
        rows += _panel(one, results, family, env_id)
    legend(made, axes)
    return Drawing(made, HEADS, rows)


def _panel(one: Axes, results: Results, family: str, env_id: str) -> list[list[Any]]:
    rows: list[list[Any]] = []
    annotated = False
    labels = in_order(set(results.labels(family)))
    # pruning carries the annotations, as in the paper; else the first sparse method
    for label in sorted(labels, key=lambda label: (label in (DENSE, EQUAL), label != "prune")):
        points = []
        for level in [0.0] if label == DENSE else results.levels(family):
            runs = results.cell(family, env_id, label, level)
            if runs:
                parameters = fmean(run.parameters for run in runs)
                points.append((parameters, level, mean([run.score for run in runs])))
        for parameters, level, e in points:
            rows.append(
                [family, env_id, label, level, round(parameters), e.value, e.low, e.high, e.seeds]
            )
        if not points:
            continue
        if label == DENSE:
            _horizontal(one, points[0][2].value, points[0][2].low, points[0][2].high)
            continue
        points.sort(key=lambda point: point[0])
        look = look_of(label)
        estimates_line(one, [p[0] for p in points], [p[2] for p in points], look, name_of(label))
        if label != EQUAL and not annotated:
            annotated = True
            for parameters, level, e in points:
                one.annotate(
                    percent(level), (parameters, e.value), textcoords="offset points",
                    xytext=(0, 6), ha="center", fontsize=7, color=look.color,
                )  # fmt: skip
            known = {level: parameters for parameters, level, _ in points}
            marked = next((level for level in MARKED if level in known), None)
            if marked is not None:
                one.axvline(known[marked], color="#999999", linewidth=0.9, linestyle=":")
    one.margins(x=0.1, y=0.12)
    sizes = {float(row[4]) for row in rows if row[2] != DENSE}
    if max(sizes) < 1.5 * min(sizes):
        one.set_xlim(min(sizes) / 2, max(sizes) * 2)
    logarithmic(one, "x")
    one.set_title(f"{family}\n{env_id}")
    one.set_xlabel("parameters")
    one.set_ylabel("mean score")
    return rows


def _horizontal(one: Axes, value: float, low: float, high: float) -> None:
    look = look_of(DENSE)
    one.axhline(value, color=look.color, linestyle=look.line, label=name_of(DENSE))
    if not np.isnan(low):
        one.axhspan(low, high, color=look.color, alpha=0.08, linewidth=0)
