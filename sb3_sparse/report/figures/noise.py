"""The return of trained policies under observation noise."""

from __future__ import annotations

from collections.abc import Collection

from sb3_sparse.pages.plot import Drawing
from sb3_sparse.report.figures.base import figure
from sb3_sparse.report.figures.compare import Line, compared, stacked
from sb3_sparse.report.figures.grid import Place
from sb3_sparse.report.measured import NOISE, returns_by_sigma
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import NotEnoughData, Results, cell_of
from sb3_sparse.zoo.environments import ATARI, suite_of

HEADS = ("algorithm and tasks", "environment", "method", "parameters kept", "sigma", "return",
         "low", "high", "seeds")  # fmt: skip


@figure(
    "noise",
    "Robustness to observation noise",
    "Mean return of policies at the end of training against the strength of the noise that is "
    "added to observations: from five seeds on with 95 % Student t intervals, below that with a "
    "thin line for each seed. The unit is the standard deviation of each entry of the observation, "
    "of images a grey level. The dense network of full size is grey in every panel.",
)
def draw(results: Results) -> Drawing:
    """Draw a row for each environment, and a panel for each sparsity, or method and sparsity."""
    found: dict[Place, dict[Line, list[dict[float, float]]]] = {}
    for run in sorted(results.main, key=lambda run: (*cell_of(run), run.seed)):
        by_sigma = returns_by_sigma(run.measured)
        if by_sigma:
            lines = found.setdefault(Place(run.family, run.env_id), {})
            lines.setdefault((run.label, run.level, ""), []).append(by_sigma)
    if not found:
        raise NotEnoughData(f"no run has a {NOISE}")
    grid, panels = compared(HEADS, found, x=_strength(found), y="mean return")
    for panel in panels:
        for line in panel.lines:
            label, level, _ = line
            sigmas, values = stacked(found[panel.place][line])
            if sigmas:
                rows = [panel.place.family, panel.place.env_id, label, 1 - level]
                within = possible_returns(panel.place.env_id)
                grid.curve(panel.axes, rows, sigmas, values, label, panel.text(label), within)
    return grid.drawing()


def _strength(places: Collection[Place]) -> str:
    """Name the axis of strengths, with their unit if all tasks have the same."""
    images = {suite_of(place.env_id) == ATARI for place in places}
    if len(images) > 1:
        return "standard deviation of the noise"
    if True in images:
        return "standard deviation of the noise, grey levels"
    return "noise, in standard deviations of the observation"
