"""The final reward against what networks of several widths cost: parameters, or seconds."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean

from sb3_sparse.pages.lines import logarithmic, points
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import Line, compared
from sb3_sparse.report.figures.grid import Place
from sb3_sparse.report.methods import look_of
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import NotEnoughData, Results

HEADS = ("algorithm and tasks", "environment", "method", "sparsity", "net_arch")
ENDS = ("mean score", "low", "high", "seeds")
Cost = Callable[[RunData], float | None]
Lines = dict[Line, dict[str, list[RunData]]]
"""The runs of each width, by method, sparsity and all other settings."""


@figure(
    "scaling",
    "Final reward against parameter count, over widths",
    "Mean score against active parameters on a logarithmic axis, a point for each width of the "
    "network (net_arch): from five seeds on with 95 % Student t intervals, below that with a small "
    "dot for each seed. A point to the upper left of another has more reward for fewer parameters. "
    "The dense network is grey in every panel.",
)
def draw_parameters(results: Results) -> Drawing:
    """Draw a row for each environment, and a panel for each sparsity, or method and sparsity."""
    found = {
        place: kept
        for place, lines in _found(results, lambda run: run.parameters).items()
        if (kept := {line: widths for line, widths in lines.items() if len(widths) > 1})
    }
    if not found:
        raise NotEnoughData(
            "no method was trained with two or more widths (net_arch) and otherwise equal settings"
        )
    return _drawing(found, lambda run: run.parameters, "parameters", "active parameters")


@figure(
    "seconds",
    "Final reward against seconds of training",
    "Mean score against the mean seconds that a run trained, evaluations left out, on a "
    "logarithmic axis, a point for each width of the network (net_arch): from five seeds on with "
    "95 % Student t intervals, below that with a small dot for each seed. Seconds are those of the "
    "processor, over all threads, or on a GPU those that passed; they depend on the machine. A "
    "point to the upper left of another has more reward in less time. The dense network is grey in "
    "every panel.",
)
def draw_seconds(results: Results) -> Drawing:
    """Draw a row for each environment, and a panel for each sparsity, or method and sparsity."""
    found = _found(results, lambda run: run.seconds)
    if not found:
        raise NotEnoughData("no record of a trained run has its seconds of training")
    what = "seconds of training"
    return _drawing(found, lambda run: run.seconds, what, what)


def _found(results: Results, cost: Cost) -> dict[Place, Lines]:
    """Group the trained runs whose cost is known."""
    found: dict[Place, Lines] = {}
    for run in sorted(results.trained, key=lambda run: (run.family, run.env_id, run.seed)):
        if cost(run) is not None:
            lines = found.setdefault(Place(run.family, run.env_id), {})
            widths = lines.setdefault((run.label, run.level, run.variant("net_arch")), {})
            widths.setdefault(str(run.asked.value("net_arch")), []).append(run)
    return found


def _drawing(found: dict[Place, Lines], cost: Cost, head: str, x_label: str) -> Drawing:
    grid, panels = compared((*HEADS, head, *ENDS), found, x=x_label, y="mean score")
    for panel in panels:
        place = panel.place
        for line in panel.lines:
            label, level, _ = line
            drawn = []
            for widths, runs in found[place][line].items():
                x = fmean(cost(run) or 0.0 for run in runs)
                scores = [run.score for run in runs]
                drawn.append((x, scores))
                row = [place.family, place.env_id, label, level, widths]
                grid.note_once(row, [round(x, 1)], [scores])
            drawn.sort(key=lambda point: point[0])
            within, text = possible_returns(place.env_id), panel.text(label)
            given = [scores for _, scores in drawn]
            points(panel.axes, [x for x, _ in drawn], given, look_of(label), text, within)
        panel.axes.margins(x=0.12)
        panel.axes.set_xscale("log")
    for panel in panels:
        logarithmic(panel.axes, "x")
    return grid.drawing()
