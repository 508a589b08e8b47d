"""The reward against a setting that was varied."""

from __future__ import annotations

from typing import Any

from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.methods import DENSE, in_order, look_of, name_of, percent
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import mean

HEADS = ("family", "environment", "sparsity", "method", "setting", "value", "mean score", "low",
         "high", "seeds")  # fmt: skip
Place = tuple[str, str, float]


@figure(
    "sensitivity",
    "Sensitivity to a setting",
    "Mean score against the values of the setting that was varied, all other settings of a line "
    "being the same, with 95 % Student t intervals; a panel for each environment and sparsity.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each environment and sparsity, with a line for each method."""
    name = results.varies
    if name is None:
        raise NotEnoughData("it needs the name of the setting that was varied (varies)")
    found: dict[Place, dict[tuple[str, str], dict[Any, list[RunData]]]] = {}
    for run in results.trained:
        kind = (run.label, run.variant(name))
        values = found.setdefault((run.family, run.env_id, run.level), {}).setdefault(kind, {})
        values.setdefault(_key(results.setting(run, name)), []).append(run)
    places = {
        place: kept
        for place, lines in found.items()
        if (kept := {kind: values for kind, values in lines.items() if len(values) > 1})
    }
    if not places:
        raise NotEnoughData(
            f"no method was trained with two or more values of {name} and otherwise equal settings"
        )
    sheet = Sheet(HEADS, len(places), height=3.0)
    panels = zip(sheet.axes, sorted(places.items()), strict=True)
    for one, ((family, env_id, level), lines) in panels:
        ticks = sorted({value for values in lines.values() for value in values}, key=_order)
        order = in_order({label for label, _ in lines})
        for (label, _), values in sorted(lines.items(), key=lambda item: order.index(item[0][0])):
            estimates = {
                value: mean([run.score for run in values[value]])
                for value in ticks
                if value in values
            }
            place = [family, env_id, level, label, name]
            x = [float(ticks.index(value)) for value in estimates]
            sheet.estimates(one, place, estimates, x, look_of(label), name_of(label))
        one.set_xticks(range(len(ticks)), [str(value) for value in ticks])
        at = "" if level == 0 and order == [DENSE] else f", {percent(level)}"
        one.set(title=f"{family}\n{env_id}{at}", xlabel=name, ylabel="mean score")
    return sheet.drawing()


def _key(value: Any) -> Any:
    """Return a value as a tick of the axis."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(f"{value:.6g}")
    if isinstance(value, (list, tuple)):
        return ", ".join(map(str, value)) or "none"
    return str(value)


def _order(value: Any) -> tuple[bool, float, str]:
    number = value if isinstance(value, float) else 0.0
    return isinstance(value, str), number, str(value)
