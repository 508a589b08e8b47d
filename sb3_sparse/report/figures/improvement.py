"""The probability that one method beats another."""

from __future__ import annotations

from sb3_sparse.pages.backend import Axes
from sb3_sparse.pages.lines import SEED
from sb3_sparse.pages.plot import GREY, Drawing
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.intervals import by_sparsity, estimate
from sb3_sparse.report.methods import DENSE, EQUAL, in_order, look_of, name_of
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.scores import panels_of
from sb3_sparse.report.statistics import chances, improvement

HEADS = ("algorithm and tasks", "sparsity", "method", "against", "probability", "low", "high",
         "seeds", "tasks")  # fmt: skip
OTHERS = {EQUAL: "vs dense, equal parameters", DENSE: "vs dense", "set": "vs SET"}
Pair = tuple[str, str]


@figure(
    "improvement",
    "Probability of improvement",
    "Probability that a run of the method scores higher than one of what it is compared with, on "
    "the same task, mean over tasks, ties counted half: from five seeds on with 95 % stratified "
    "bootstrap intervals (rliable), below that with a small dot for each seed. 50 % is no "
    "difference.",
)
def draw(results: Results) -> Drawing:
    """Draw sparse methods against both dense networks, and RigL against SET."""
    found, remarks = panels_of(results)
    paired = [panel for panel in found if _pairs(list(panel.scores))]
    if not paired:
        raise NotEnoughData("no sparsity has two methods to compare")
    pairs = _pairs(in_order({label for panel in paired for label in panel.scores}))
    lines = _lines(pairs)
    grid, axes = by_sparsity(HEADS, paired, len(lines), "probability of a higher score")
    for one, panel in zip(axes, paired, strict=True):
        for better, worse in _pairs(list(panel.scores)):
            x, y = panel.scores[better], panel.scores[worse]
            given = improvement(x, y)
            row = [panel.family, panel.level, better, worse, given.value, given.low, given.high]
            grid.rows.append([*row, given.seeds, len(panel.tasks)])
            place = lines.index((better, worse))
            estimate(one, place, given, chances(x, y).tolist(), look_of(better), SEED)
        _axes(one, lines)
    return grid.drawing(remarks)


def _axes(one: Axes, lines: list[Pair]) -> None:
    one.axvline(0.5, color=GREY, linewidth=0.9, zorder=1)
    one.set_xlim(-0.06, 1.06)
    one.set_xticks([0, 0.5, 1], ["0 %", "50 %", "100 %"])
    texts = [name_of(better) or OTHERS[worse] for better, worse in lines]
    one.set_yticks(range(len(lines)), texts)
    for (better, _), tick in zip(lines, one.yaxis.get_major_ticks(), strict=True):
        if not better:
            tick.label1.set_fontweight("bold")
            tick.gridline.set_visible(False)
            # Invisible would not do: matplotlib measures one of an axis's ticks, by chance.
            tick.tick1line.set_markersize(0)
    one.set_ylim(len(lines) - 0.4, -0.6)


def _pairs(labels: list[str]) -> list[Pair]:
    dense = [label for label in (EQUAL, DENSE) if label in labels]
    sparse = [label for label in labels if label not in (EQUAL, DENSE)]
    pairs = [(label, other) for other in dense for label in sparse]
    return pairs + ([("rigl", "set")] if {"rigl", "set"} <= set(sparse) else [])


def _lines(pairs: list[Pair]) -> list[Pair]:
    """Return the lines of a panel: above the pairs against a method, one that only names it."""
    lines: list[Pair] = []
    for better, worse in pairs:
        if worse not in {other for _, other in lines}:
            lines.append(("", worse))
        lines.append((better, worse))
    return lines
