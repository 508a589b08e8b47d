"""The final reward against what networks of several widths cost: parameters, or seconds."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean

from sb3_sparse.pages.plot import Drawing, line, logarithmic
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures.base import Sheet, ends_of, figure
from sb3_sparse.report.methods import DENSE, in_order, name_of, percent, shaded
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import mean

HEADS = ("family", "environment", "method", "sparsity", "net_arch")
ENDS = ("mean score", "low", "high", "seeds")
Place = tuple[str, str]
Line = tuple[str, float, str]
Cost = Callable[[RunData], float | None]
Lines = dict[Line, dict[str, list[RunData]]]
"""The runs of each width, by method, sparsity and all other settings."""


@figure(
    "scaling",
    "Final reward against parameter count, over widths",
    "Mean score against active parameters on a logarithmic axis, with 95 % Student t intervals; a "
    "line for each method and sparsity, a point for each width of the network (net_arch). A point "
    "to the upper left of another has more reward for fewer parameters.",
)
def draw_parameters(results: Results) -> Drawing:
    """Draw a panel for each environment, with a line for each method and sparsity."""
    found = _found(results, lambda run: run.parameters)
    if not any(len(points) > 1 for lines in found.values() for points in lines.values()):
        raise NotEnoughData(
            "no method was trained with two or more widths (net_arch) and otherwise equal settings"
        )
    return _drawing(found, lambda run: run.parameters, "parameters")


@figure(
    "seconds",
    "Final reward against seconds of training",
    "Mean score against the mean seconds that a run trained, evaluations left out, on a "
    "logarithmic axis, with 95 % Student t intervals; a line for each method and sparsity, a point "
    "for each width of the network (net_arch). Seconds are those of the processor, over all "
    "threads, or on a GPU those that passed; they depend on the machine. A point to the upper left "
    "of another has more reward in less time.",
)
def draw_seconds(results: Results) -> Drawing:
    """Draw a panel for each environment, with a line for each method and sparsity."""
    found = _found(results, lambda run: run.seconds)
    if not found:
        raise NotEnoughData("no record of a trained run has its seconds of training")
    return _drawing(found, lambda run: run.seconds, "seconds of training")


def _found(results: Results, cost: Cost) -> dict[Place, Lines]:
    """Group the trained runs whose cost is known."""
    found: dict[Place, Lines] = {}
    for run in results.trained:
        if cost(run) is not None:
            lines = found.setdefault((run.family, run.env_id), {})
            points = lines.setdefault((run.label, run.level, run.variant("net_arch")), {})
            points.setdefault(str(run.asked.value("net_arch")), []).append(run)
    return found


def _drawing(found: dict[Place, Lines], cost: Cost, what: str) -> Drawing:
    sheet = Sheet((*HEADS, what, *ENDS), len(found), height=3.2)
    for one, ((family, env_id), lines) in zip(sheet.axes, sorted(found.items()), strict=True):
        order = in_order({label for label, *_ in lines})
        levels = sorted({level for label, level, _ in lines if label != DENSE})
        for (label, level, _), points in sorted(
            lines.items(), key=lambda item: (order.index(item[0][0]), *item[0][1:])
        ):
            drawn = []
            for widths, runs in points.items():
                x = fmean(cost(run) or 0.0 for run in runs)
                drawn.append((x, widths, mean([run.score for run in runs])))
            drawn.sort(key=lambda point: point[0])
            for x, widths, estimate in drawn:
                sheet.note([family, env_id, label, level, widths], {round(x, 1): estimate})
            dense = label == DENSE
            look = shaded(label, 0 if dense else 1 + levels.index(level))
            text = name_of(label) if dense else f"{name_of(label)}, {percent(level)}"
            ends = ends_of([estimate for *_, estimate in drawn])
            line(one, [x for x, *_ in drawn], ends, look, text)
        one.margins(x=0.1, y=0.12)
        logarithmic(one, "x")
        one.set(title=f"{family}\n{env_id}", xlabel=what, ylabel="mean score")
    return sheet.drawing()
