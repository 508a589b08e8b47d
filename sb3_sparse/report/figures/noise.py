"""The return of trained policies under observation noise."""

from __future__ import annotations

from collections import defaultdict

from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.measured import NOISE, returns_by_sigma
from sb3_sparse.report.methods import DENSE, name_of, percent, shaded
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import means_at

HEADS = ("family", "environment", "method", "parameters kept", "sigma", "return", "low", "high",
         "seeds")  # fmt: skip


@figure(
    "noise",
    "Robustness to observation noise",
    "Mean return of trained policies against the strength of noise added to observations, with "
    "95 % Student t intervals over seeds; colours tell how many parameters are kept, markers "
    "and line styles the method.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each environment, with a line for each method and regime."""
    found: dict[tuple[str, str], dict[tuple[float, str], list[dict[float, float]]]] = {}
    for run in results.main:
        by_sigma = returns_by_sigma(run.measured)
        if by_sigma:
            lines = found.setdefault((run.family, run.env_id), defaultdict(list))
            lines[run.level, run.label].append(by_sigma)
    if not found:
        raise NotEnoughData(f"no run has a {NOISE}")
    sheet = Sheet(HEADS, len(found), height=3.2)
    regimes = sorted({level for lines in found.values() for level, _ in lines})
    for one, ((family, env_id), lines) in zip(sheet.axes, sorted(found.items()), strict=True):
        for (level, label), seeds in sorted(lines.items()):
            sigmas, ends = means_at(seeds)
            if not sigmas:
                continue
            look = shaded(label, regimes.index(level))
            kept = "" if label == DENSE else f", {percent(1 - level)} kept"
            place = [family, env_id, label, 1 - level]
            sheet.line(one, place, sigmas, ends, [len(seeds)], look, f"{name_of(label)}{kept}")
        one.set(title=f"{family}\n{env_id}", xlabel="σ of the noise", ylabel="mean return")
    return sheet.drawing()
