"""FLOPs against sparsity, by distribution."""

from __future__ import annotations

from sb3_sparse.pages.plot import Drawing, PercentFormatter
from sb3_sparse.report.figures.base import Sheet, figure
from sb3_sparse.report.methods import DENSE, EQUAL
from sb3_sparse.report.results import NotEnoughData, Results

HEADS = ("family", "environment", "distribution", "sparsity", "flops", "dense flops", "share")
NAMES = {"erk": "ERK", "er": "ER"}
DRAWN = {
    "erk": ("#362682", "o", "-"),
    "er": ("#009E73", "^", "-."),
    "uniform": ("#FE6100", "s", "--"),
}


@figure(
    "flops",
    "FLOPs",
    "Floating-point operations of one forward pass of all networks, as a share of the dense "
    "network's, against sparsity; counted from the layers, trained or not.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each architecture, with a line for each distribution."""
    found: dict[tuple[str, str], dict[str, dict[float, tuple[int, int]]]] = {}
    for run in results.runs:
        if run.label not in (DENSE, EQUAL) and run.dense_flops:
            kind = str(results.setting(run, "distribution"))
            counted = found.setdefault((run.family, run.env_id), {}).setdefault(kind, {})
            counted.setdefault(run.level, (run.flops, run.dense_flops))
    if not found:
        raise NotEnoughData("no sparse run has its FLOPs counted")
    sheet = Sheet(HEADS, len(found), height=3.0)
    for one, ((family, env_id), lines) in zip(sheet.axes, sorted(found.items()), strict=True):
        for kind, counts in sorted(lines.items()):
            color, marker, style = DRAWN.get(kind, ("#444444", "D", ":"))
            levels = sorted(counts)
            shares = [counts[level][0] / counts[level][1] for level in levels]
            one.plot(
                levels, shares, color=color, marker=marker, linestyle=style,
                label=NAMES.get(kind, kind),
            )  # fmt: skip
            for level, share in zip(levels, shares, strict=True):
                sheet.rows.append([family, env_id, kind, level, *counts[level], share])
        one.set(title=f"{family}\n{env_id}", xlabel="sparsity", ylabel="FLOPs, share of dense")
        one.set_ylim(bottom=0)
        for axis in (one.xaxis, one.yaxis):
            axis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
    return sheet.drawing()
