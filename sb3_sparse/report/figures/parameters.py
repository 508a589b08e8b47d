"""The final reward against the parameter count."""

from __future__ import annotations

from statistics import fmean

from sb3_sparse.pages.backend import Axes, NullLocator
from sb3_sparse.pages.lines import logarithmic, points
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import MOST_LINES, no_runs
from sb3_sparse.report.figures.grid import Grid, Place, Row
from sb3_sparse.report.methods import DENSE, EQUAL, in_order, look_of, name_of, percent
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import NotEnoughData, Results

HEADS = ("algorithm and tasks", "environment", "method", "sparsity", "parameters", "mean score",
         "low", "high", "seeds")  # fmt: skip
ABOVE = 16.0  # points that the axis of sparsities takes
APART = 0.085  # least share of a panel between two of its labels
SPARE = 1.3
REFERENCE = 1.2  # points: thinner than a method's line


@figure(
    "parameters",
    "Final reward against parameter count",
    "Mean score (the last 10 % of evaluations) against active parameters on a logarithmic axis, "
    "with the sparsity above: from five seeds on with 95 % Student t intervals, which end at the "
    "returns that are possible, below that with a small dot for each seed. The horizontal line is "
    "the mean of the dense network of full size, which stands at 0 % sparsity.",
)
def draw(results: Results) -> Drawing:
    """Draw a row for each environment, and a panel for each method if there are many."""
    places = [
        Place(family, env_id)
        for family in results.families()
        for env_id in results.envs(family)
        if any(_points(results, Place(family, env_id), label) for label in results.labels(family)
               if label != DENSE)
    ]  # fmt: skip
    if not places:
        raise NotEnoughData("there is no trained run except dense ones of full size")
    labels = in_order({label for place in places for label in results.labels(place.family)})
    sparse = [label for label in labels if label not in (DENSE, EQUAL)]
    few = len(labels) <= MOST_LINES
    columns = [""] if few else [name_of(label) for label in sparse]
    x, y = "active parameters", "mean score"
    grid = Grid(HEADS, [Row(place) for place in places], columns, x=x, y=y, above=ABOVE)
    for i, place in enumerate(places):
        sizes: list[dict[float, float]] = []
        for j in range(len(columns)):
            shown = labels if few else [label for label in (DENSE, EQUAL) if label in labels]
            named = "" if few else sparse[j]
            drawn = [*shown, *([named] if named else [])]
            sizes.append(_panel(grid, grid.at(i, j), results, place, drawn, named))
        every = [size for found in sizes for size in found.values()]
        for j, found in enumerate(sizes):
            grid.at(i, j).set_xlim(min(every) / SPARE, max(every) * SPARE)
            logarithmic(grid.at(i, j), "x")
            _sparsities(grid.at(i, j), found)
        grid.at(i, 0).annotate(
            "sparsity, %", (0, 1), (-6, 6), xycoords="axes fraction", textcoords="offset points",
            ha="right", annotation_clip=False,
        )  # fmt: skip
    return grid.drawing()


def _points(results: Results, place: Place, label: str) -> list[tuple[float, float, list[float]]]:
    """Return parameters, sparsity and scores of a method, in order of parameters."""
    found = []
    for level in [0.0] if label == DENSE else results.levels(place.family):
        runs = results.cell(place.family, place.env_id, label, level)
        if runs:
            parameters = fmean(run.parameters for run in runs)
            found.append((parameters, level, [run.score for run in runs]))
    return sorted(found)


def _panel(
    grid: Grid, one: Axes, results: Results, place: Place, labels: list[str], named: str
) -> dict[float, float]:
    """Draw a panel, and return the parameters by sparsity."""
    sizes: dict[float, float] = {}
    for label in labels:
        given = _points(results, place, label)
        if label == named and not given:
            no_runs(one)
        text = "" if label == named else name_of(label)
        if given:
            x, scores = [at for at, *_ in given], [values for *_, values in given]
            sizes.update({level: at for at, level, _ in given})
            points(one, x, scores, look_of(label), text, possible_returns(place.env_id))
            if label == DENSE:
                look = look_of(label)
                one.axhline(
                    fmean(scores[0]), color=look.color, linestyle=look.line, linewidth=REFERENCE
                )
        for parameters, level, values in given:
            row = [place.family, place.env_id, label, level]
            grid.note_once(row, [round(parameters)], [values])
    return sizes


def _sparsities(one: Axes, sizes: dict[float, float]) -> None:
    """Put an axis of sparsities above a panel, with as many labels as have room."""
    above = one.secondary_xaxis("top")
    kept: list[float] = []
    for level, size in sorted(sizes.items(), key=lambda item: item[1]):
        at = one.transAxes.inverted().transform(one.transData.transform((size, 0)))[0]
        before = [
            one.transAxes.inverted().transform(one.transData.transform((sizes[other], 0)))[0]
            for other in kept
        ]
        if not before or at - max(before) >= APART:
            kept.append(level)
    above.xaxis.set_minor_locator(NullLocator())
    above.set_xticks([sizes[level] for level in kept], [percent(level)[:-2] for level in kept])
    above.spines["top"].set_visible(True)
