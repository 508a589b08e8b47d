"""The reward against the actor's share of the parameters."""

from __future__ import annotations

from collections import defaultdict
from statistics import fmean

from sb3_sparse.pages.plot import GREY, Drawing
from sb3_sparse.report.data import RunData
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import Line, Panel, compared
from sb3_sparse.report.figures.grid import Place
from sb3_sparse.report.methods import DENSE
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import NotEnoughData, Results

HEADS = ("algorithm and tasks", "environment", "method", "budget", "actor's share", "mean score",
         "low", "high", "seeds")  # fmt: skip
Shares = dict[float, list[RunData]]


@figure(
    "ratio",
    "Actor or critic",
    "Mean score against the actor's share of all connections (both critics counted), a panel for "
    "each budget of parameters: from five seeds on with 95 % Student t intervals, below that with "
    "a small dot for each seed.",
)
def draw(results: Results) -> Drawing:
    """Draw a row for each environment, and a panel for each budget."""
    found: dict[Place, dict[Line, Shares]] = {}
    for run in sorted(results.trained, key=lambda run: (run.family, run.env_id, run.seed)):
        if run.actor_share is not None:
            kind = (run.label, _budget(results, run), run.variant("actor_share", "net_arch"))
            lines = found.setdefault(Place(run.family, run.env_id), {})
            lines.setdefault(kind, {}).setdefault(round(run.actor_share, 2), []).append(run)
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
    grid, panels = compared(
        HEADS, places, x="actor's share of connections, %", y="mean score",
        level_text="{} of the parameters", dense_everywhere=False,
    )  # fmt: skip
    for panel in panels:
        place = panel.place
        for line in panel.lines:
            label, budget, _ = line
            shares = sorted(places[place][line].items())
            scores = [[run.score for run in runs] for _, runs in shares]
            names = [share for share, _ in shares]
            rows, x = [place.family, place.env_id, label, budget], [100 * x for x in names]
            within, text = possible_returns(place.env_id), panel.text(label)
            grid.points(panel.axes, rows, x, scores, label, text, within, names)
        if panel.lines:
            _standards(results, panel)
    return grid.drawing()


def _standards(results: Results, panel: Panel) -> None:
    """Draw the standard split, and the dense network of full size."""
    place = panel.place
    usual = _usual(results, place.family, place.env_id)
    if usual is not None:
        panel.axes.axvline(
            100 * usual, color=GREY, linewidth=0.9, linestyle=":", label="standard split"
        )
    dense = results.cell(place.family, place.env_id, DENSE, 0.0)
    if dense:
        score = fmean(run.score for run in dense)
        panel.axes.axhline(score, color=GREY, linewidth=0.9, label="dense network of full size")


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
