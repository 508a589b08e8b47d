"""FLOPs against sparsity, by distribution."""

from __future__ import annotations

from sb3_sparse.pages.backend import PercentFormatter
from sb3_sparse.pages.look import Look
from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.grid import Grid, Place, Row
from sb3_sparse.report.methods import DENSE, EQUAL
from sb3_sparse.report.results import NotEnoughData, Results

HEADS = ("algorithm and tasks", "environment", "distribution", "sparsity", "flops", "dense flops",
         "share")  # fmt: skip
NAMES = {"erk": "ERK", "er": "ER"}
LOOKS = {
    "erk": Look("#362682", "o", "-"),
    "er": Look("#009E73", "D", "-."),
    "uniform": Look("#FE6100", "s", "--"),
}
OTHER = Look("#444444", "p", ":")


@figure(
    "flops",
    "FLOPs",
    "Floating-point operations of one forward pass of all networks, as a share of the dense "
    "network's, against sparsity; counted from the layers, trained or not.",
)
def draw(results: Results) -> Drawing:
    """Draw a panel for each architecture, with a line for each distribution."""
    found: dict[Place, dict[str, dict[float, tuple[int, int]]]] = {}
    for run in results.runs:
        if run.label not in (DENSE, EQUAL) and run.dense_flops:
            kind = str(results.setting(run, "distribution"))
            place = Place(run.family, run.env_id)
            counted = found.setdefault(place, {}).setdefault(kind, {})
            counted.setdefault(run.level, (run.flops, run.dense_flops))
    if not found:
        raise NotEnoughData("no sparse run has its FLOPs counted")
    rows = [Row(place) for place in sorted(found)]
    grid = Grid(HEADS, rows, [""], x="sparsity", y="FLOPs, share of dense", height=2.7)
    for i, row in enumerate(rows):
        one = grid.at(i, 0)
        if i:
            one.sharex(grid.at(0, 0))
            one.sharey(grid.at(0, 0))
            one.tick_params(labelleft=i % grid.columns == 0)
        for kind, counts in sorted(found[row.place].items()):
            look, levels = LOOKS.get(kind, OTHER), sorted(counts)
            shares = [counts[level][0] / counts[level][1] for level in levels]
            one.plot(
                levels, shares, color=look.color, marker=look.marker, linestyle=look.line,
                label=NAMES.get(kind, kind),
            )  # fmt: skip
            for level, share in zip(levels, shares, strict=True):
                at = [row.place.family, row.place.env_id, kind, level]
                grid.rows.append([*at, *counts[level], share])
        for axis in (one.xaxis, one.yaxis):
            axis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
    grid.at(0, 0).set_ylim(0, 1.02 * grid.at(0, 0).get_ylim()[1])
    return grid.drawing()
