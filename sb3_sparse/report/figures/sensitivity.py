"""The reward against a setting that was varied."""

from __future__ import annotations

from typing import Any

from sb3_sparse.pages.numbers import short
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import Line, compared
from sb3_sparse.report.figures.grid import Place
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.values import order_of, shown_value

HEADS = ("algorithm and tasks", "environment", "sparsity", "method", "setting", "value",
         "mean score", "low", "high", "seeds")  # fmt: skip


@figure(
    "sensitivity",
    "Sensitivity to a setting",
    "Mean score against the values of the setting that was varied, all other settings of a line "
    "being the same: from five seeds on with 95 % Student t intervals, below that with a small dot "
    "for each seed.",
)
def draw(results: Results) -> Drawing:
    """Draw a row for each environment, and a panel for each sparsity, or method and sparsity."""
    name = results.varies
    if name is None:
        raise NotEnoughData("it needs the name of the setting that was varied (varies)")
    found: dict[Place, dict[Line, dict[Any, list[RunData]]]] = {}
    for run in sorted(results.trained, key=lambda run: (run.family, run.env_id, run.seed)):
        lines = found.setdefault(Place(run.family, run.env_id), {})
        values = lines.setdefault((run.label, run.level, run.variant(name)), {})
        values.setdefault(shown_value(results.setting(run, name)), []).append(run)
    places = {
        place: kept
        for place, lines in found.items()
        if (kept := {line: values for line, values in lines.items() if len(values) > 1})
    }
    if not places:
        raise NotEnoughData(
            f"no method was trained with two or more values of {name} and otherwise equal settings"
        )
    grid, panels = compared(HEADS, places, x=name, y="mean score")
    for panel in panels:
        place = panel.place
        lines = places[place]
        ticks = sorted({value for values in lines.values() for value in values}, key=order_of)
        for line in panel.lines:
            label, level, _ = line
            given = sorted(lines[line].items(), key=lambda item: order_of(item[0]))
            names = [value for value, _ in given]
            x = [float(ticks.index(value)) for value in names]
            scores = [[run.score for run in runs] for _, runs in given]
            rows = [place.family, place.env_id, level, label, name]
            within, text = possible_returns(place.env_id), panel.text(label)
            grid.points(panel.axes, rows, x, scores, label, text, within, names)
        panel.axes.set_xticks(range(len(ticks)), [_text(value) for value in ticks])
        panel.axes.set_xlim(-0.3, len(ticks) - 0.7)
    return grid.drawing()


def _text(value: Any) -> str:
    return short(value, 6) if isinstance(value, float) else str(value)
