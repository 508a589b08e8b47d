"""The reward against the actor's share of the parameters."""

from __future__ import annotations

from collections import defaultdict

from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.methods import DENSE, name_of, percent, shaded
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import mean

HEADS = ("family", "environment", "method", "budget", "actor's share", "mean score", "low", "high",
         "seeds")  # fmt: skip
Line = tuple[str, float, str]


@figure(
    "ratio",
    "Actor or critic",
    "Mean score against the actor's share of all connections (both critics counted) for each "
    "budget of parameters, with 95 % Student t intervals. The vertical line is the standard "
    "split, the horizontal one the dense network of full size.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each environment, with a line for each budget and method."""
    found: dict[tuple[str, str], dict[Line, dict[float, list[RunData]]]] = {}
    for run in results.trained:
        if run.actor_share is not None:
            kind = (run.label, _budget(results, run), run.variant("actor_share", "net_arch"))
            shares = found.setdefault((run.family, run.env_id), {}).setdefault(kind, {})
            shares.setdefault(round(run.actor_share, 2), []).append(run)
    places = {
        place: kept
        for place, lines in found.items()
        if (kept := {kind: shares for kind, shares in lines.items() if len(shares) > 1})
    }
    if not places:
        raise NotEnoughData(
            "no method was trained with two or more shares of the actor (actor_share) and "
            "otherwise equal settings"
        )
    sheet = Sheet(HEADS, len(places), height=3.0)
    for one, ((family, env_id), lines) in zip(sheet.axes, sorted(places.items()), strict=True):
        budgets = sorted({budget for _, budget, _ in lines}, reverse=True)
        for (label, budget, _), shares in sorted(lines.items()):
            estimates = {x: mean([run.score for run in runs]) for x, runs in sorted(shares.items())}
            look = shaded(label, budgets.index(budget))
            name = "Dense" if label == DENSE else name_of(label)
            text = f"{name}, {percent(budget)} of parameters"
            place = [family, env_id, label, budget]
            sheet.estimates(one, place, estimates, [100 * x for x in estimates], look, text)
        usual = _usual(results, family, env_id)
        if usual is not None:
            one.axvline(100 * usual, color="#999999", linewidth=0.9, linestyle=":")
        dense = results.cell(family, env_id, DENSE, 0.0)
        if dense:
            level_line = mean([run.score for run in dense]).value
            one.axhline(level_line, color="#444444", linestyle="--", label=name_of(DENSE))
        title = f"{family}\n{env_id}"
        one.set(title=title, xlabel="actor's share of connections, %", ylabel="mean score")
    return sheet.drawing()


def _budget(results: Results, run: RunData) -> float:
    """Return the share of the largest dense network's connections, for dense runs to one digit."""
    if run.label != DENSE:
        return round(1 - run.level, 6)
    dense = [
        other.connections
        for other in results.trained
        if (other.family, other.env_id, other.label) == (run.family, run.env_id, DENSE)
    ]
    return float(f"{run.connections / max(dense):.1g}")


def _usual(results: Results, family: str, env_id: str) -> float | None:
    """Return the standard split, i.e. that of the runs without an ``actor_share``."""
    shares: dict[str, list[float]] = defaultdict(list)
    for run in results.trained:
        if (run.family, run.env_id) == (family, env_id) and run.actor_share is not None:
            widths = "net_arch" in run.record["run"].get("hyperparams", {})
            asked = widths or results.setting(run, "actor_share") is not None
            shares["asked" if asked else "usual"].append(run.actor_share)
    return sorted(shares["usual"])[len(shares["usual"]) // 2] if shares["usual"] else None
