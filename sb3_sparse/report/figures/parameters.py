"""The final reward against the parameter count."""

from __future__ import annotations

from statistics import fmean

import numpy as np

from sb3_sparse.pages.plot import Axes, Drawing, line, logarithmic
from sb3_sparse.report.figures.base import Sheet, ends_of, figure
from sb3_sparse.report.methods import DENSE, EQUAL, in_order, look_of, name_of, percent
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import Estimate, mean

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
    """Draw a panel for each environment, with a line for each method."""
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
        raise NotEnoughData("there is no trained run except dense ones of full size")
    sheet = Sheet(HEADS, len(places), height=3.2)
    for one, (family, env_id) in zip(sheet.axes, places, strict=True):
        _panel(one, sheet, results, family, env_id)
    return sheet.drawing()


def _panel(one: Axes, sheet: Sheet, results: Results, family: str, env_id: str) -> None:
    annotated = False
    sizes: list[float] = []
    labels = in_order(set(results.labels(family)))
    # Pruning carries the annotations, as in the paper, or else the first sparse method.
    for label in sorted(labels, key=lambda label: (label in (DENSE, EQUAL), label != "prune")):
        points = []
        for level in [0.0] if label == DENSE else results.levels(family):
            runs = results.cell(family, env_id, label, level)
            if runs:
                parameters = fmean(run.parameters for run in runs)
                points.append((parameters, level, mean([run.score for run in runs])))
        for parameters, level, estimate in points:
            sheet.note([family, env_id, label, level], {round(parameters): estimate})
        if not points:
            continue
        if label == DENSE:
            _horizontal(one, points[0][2])
            continue
        points.sort(key=lambda point: point[0])
        sizes += [parameters for parameters, _, _ in points]
        look = look_of(label)
        line(one, [p[0] for p in points], ends_of([p[2] for p in points]), look, name_of(label))
        if label != EQUAL and not annotated:
            annotated = True
            _annotate(one, points, look.color)
    one.margins(x=0.1, y=0.12)
    if max(sizes) < 1.5 * min(sizes):
        one.set_xlim(min(sizes) / 2, max(sizes) * 2)
    logarithmic(one, "x")
    one.set(title=f"{family}\n{env_id}", xlabel="parameters", ylabel="mean score")


def _annotate(one: Axes, points: list[tuple[float, float, Estimate]], color: str) -> None:
    """Write the sparsities along a line, and mark one of them."""
    for parameters, level, estimate in points:
        one.annotate(
            percent(level), (parameters, estimate.value), textcoords="offset points",
            xytext=(0, 6), ha="center", fontsize=7, color=color,
        )  # fmt: skip
    known = {level: parameters for parameters, level, _ in points}
    marked = next((level for level in MARKED if level in known), None)
    if marked is not None:
        one.axvline(known[marked], color="#999999", linewidth=0.9, linestyle=":")


def _horizontal(one: Axes, dense: Estimate) -> None:
    look = look_of(DENSE)
    one.axhline(dense.value, color=look.color, linestyle=look.line, label=name_of(DENSE))
    if not np.isnan(dense.low):
        one.axhspan(dense.low, dense.high, color=look.color, alpha=0.08, linewidth=0)
