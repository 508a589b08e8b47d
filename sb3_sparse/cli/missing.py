"""What a study lacks: its runs, what they cost, and what a verdict on each finding needs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from sb3_sparse.errors import MissingExtra
from sb3_sparse.studies.cost import Cost, Costs, but_for_seeds
from sb3_sparse.studies.status import CellState, CellStatus, readable

if TYPE_CHECKING:
    from sb3_sparse.report import Results, Verdict

COUNTED = (
    "Core hours are the processor's seconds of training, by medians of runs that have been timed; "
    "evaluations and measures of trained models come on top."
)


def costs_of(statuses: Sequence[CellStatus], costs: Costs) -> Iterator[str]:
    """Yield a line for each environment, with what is left of it, and their sum."""
    total, env_ids = Cost(), dict.fromkeys(one.cell.run.env_id for one in statuses)
    for env_id in env_ids:
        here = [one for one in statuses if one.cell.run.env_id == env_id]
        done = sum(one.state is CellState.DONE for one in here)
        left = costs.left(here)
        total += left
        told = "; ".join([f"left {left}", *left.remarks()])
        yield f"  {env_id}: {done} of {len(here)}" + (f"; {told}" if left.runs else "")
    if total.runs and len(env_ids) > 1:
        yield f"Left in all: {total}"
    if total.seconds:
        yield COUNTED


def findings_of(
    statuses: Sequence[CellStatus],
    costs: Costs,
    findings: tuple[str, ...] | None,
    references: Mapping[str, tuple[float, float]],
) -> Iterator[str]:
    """Yield a line for each finding that a study tests and on which its done cells have data.

    A line gives the verdict, or what it probably needs. Without the extra for reports, there is
    one line that names it.

    :param findings: keys of the findings; None for all of the paper
    :param references: the returns that become 0 and 1, by environment
    """
    if not any(one.state is CellState.DONE for one in statuses):
        return
    try:
        from sb3_sparse.report import Results, judge, read_runs
        from sb3_sparse.report.normalisation import CURE
    except MissingExtra as error:
        yield f"No verdicts: {error}"
        return
    runs, _ = read_runs(*readable(statuses))
    results = Results(tuple(runs), findings=findings, references=references)
    verdicts = [one for one in judge(results) if one.has_data]
    if verdicts:
        yield "Findings of the paper on which there are data:"
    for task in results.normaliser.missing:
        yield f"No scale: {task}; {CURE}"
    for one in verdicts:
        family = f", {one.family}" if len(results.families()) > 1 else ""
        yield f"  {one.finding.key}{family}: {_told(one)}{_needed(one, results, statuses, costs)}"


def _told(one: Verdict) -> str:
    return f"{one.verdict}, {one.shown}, {one.seeds} seeds" if one.shown else one.verdict


def _needed(one: Verdict, results: Results, statuses: Sequence[CellStatus], costs: Costs) -> str:
    """Say what an open verdict needs; nothing for the others."""
    from sb3_sparse.report.findings import UNDECIDED
    from sb3_sparse.report.verdicts import LEAST_SEEDS

    if one.verdict != UNDECIDED:
        return ""
    if one.effect is not None and one.needed is None:
        return f"; {'more than 1,000 would be needed' if one.region else one.remark}"
    taken = {run.folder for run in one.finding.sides(results, one.family).runs}
    kinds = [
        same
        for same in but_for_seeds(statuses)
        if any(status.folder.path in taken for status in same)
    ]
    if one.needed is None:
        seeds, would = LEAST_SEEDS, f"{LEAST_SEEDS} seeds are the least"
    else:
        seeds, would = one.needed, f"about {one.needed} would decide if the effect stays"
    cost = sum((costs.to_seeds(same, seeds) for same in kinds), Cost())
    planned = max(map(len, kinds))
    beyond = f" (the study has {planned} seeds)" if seeds > planned else ""
    return f"; {would}: {cost}{beyond}"
