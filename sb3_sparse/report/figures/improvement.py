"""The probability that one method beats another."""

from __future__ import annotations

from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.methods import DENSE, EQUAL, look_of, name_of
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.scores import panels_of
from sb3_sparse.report.statistics import improvement

HEADS = ("family", "sparsity", "method", "against", "probability", "low", "high", "seeds", "tasks")
SHORT = {DENSE: "dense 100 %", EQUAL: "equal dense"}


@figure(
    "improvement",
    "Probability of improvement",
    "Probability that a run of the first method scores higher than one of the second on the same "
    "task, mean over tasks, ties counted half, with 95 % stratified bootstrap intervals (rliable). "
    "The vertical line marks no difference.",
)
def draw(results: Results) -> Drawing:
    """Draw sparse methods against both dense networks, and RigL against SET."""
    found, remarks = panels_of(results)
    paired = [(panel, pairs) for panel in found if (pairs := _pairs(list(panel.scores)))]
    if not paired:
        raise NotEnoughData("no sparsity has two methods to compare")
    most = max(len(pairs) for _, pairs in paired)
    sheet = Sheet(HEADS, len(paired), height=1.2 + 0.26 * most)
    for one, (panel, pairs) in zip(sheet.axes, paired, strict=True):
        for place, (better, worse) in enumerate(pairs):
            estimate = improvement(panel.scores[better], panel.scores[worse])
            value, low, high = estimate.value, estimate.low, estimate.high
            look = look_of(better)
            one.plot([low, high], [place, place], color=look.color, linewidth=4, alpha=0.4)
            one.plot(value, place, look.marker, color=look.color, markersize=6)
            row = [panel.family, panel.level, better, worse, value, low, high]
            sheet.rows.append([*row, estimate.seeds, len(panel.tasks)])
        one.axvline(0.5, color="#444444", linewidth=0.8)
        one.set_xlim(-0.06, 1.06)
        texts = [f"{name_of(a)} > {SHORT.get(b, name_of(b))}" for a, b in pairs]
        one.set_yticks(range(len(pairs)), texts)
        one.invert_yaxis()
        one.set(title=panel.title, xlabel="probability")
    return sheet.drawing(remarks)


def _pairs(labels: list[str]) -> list[tuple[str, str]]:
    dense = [label for label in (EQUAL, DENSE) if label in labels]
    sparse = [label for label in labels if label not in (EQUAL, DENSE)]
    pairs = [(label, other) for other in dense for label in sparse]
    return pairs + ([("rigl", "set")] if {"rigl", "set"} <= set(sparse) else [])
