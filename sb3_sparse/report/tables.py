"""The tables of a report: cells, runs and verdicts."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import numpy as np

from sb3_sparse.pages.table import Cell, Table
from sb3_sparse.report.data import RunData
from sb3_sparse.report.findings import CONTRADICTED, SUPPORTED, UNDECIDED
from sb3_sparse.report.methods import DENSE, EQUAL, name_of
from sb3_sparse.report.results import Results, cell_of, grouped
from sb3_sparse.report.statistics import LEAST, iqm, iqm_estimates
from sb3_sparse.report.verdicts import Verdict

MARKS = {SUPPORTED: "good", CONTRADICTED: "bad", UNDECIDED: "open"}


def cells_table(results: Results) -> Table:
    """Return a row for each family, environment, method, sparsity and variant of settings."""
    heads = ["algorithm and tasks", "environment", "method", "sparsity", "distribution"]
    heads += ["settings", "compared"]
    if results.varies:
        heads.append(results.varies)
    heads += ["seeds", "mean score", "std", "IQM", "low", "high", "normalised mean"]
    rows = []
    main = {id(run) for run in results.main}
    for _, members in sorted(grouped(results.runs, cell_of).items()):
        variants: dict[str, list[RunData]] = {}
        for run in members:
            variants.setdefault(f"{run.trained}{run.variant()}", []).append(run)
        for number, runs in enumerate(variants.values(), start=1):
            rows.append(_cell(results, runs, f"{number} of {len(variants)}", id(runs[0]) in main))
    return Table([*heads, "parameters", "FLOPs", "FLOPs of dense"], rows)


def _cell(results: Results, runs: list[RunData], number: str, compared: bool) -> list[Any]:
    first = runs[0]
    dense = first.label in (DENSE, EQUAL)
    row: list[Any] = [first.family, first.env_id, name_of(first.label), first.level]
    row += [None if dense else results.setting(first, "distribution"), number]
    row.append("yes" if compared else "no" if first.trained else "counted only")
    if results.varies:
        row.append(str(results.setting(first, results.varies)))
    if first.trained:
        scores = np.array([run.score for run in runs])
        known = [x for run in runs if (x := results.normaliser(run)) is not None]
        row += [len(runs), float(scores.mean())]
        if len(runs) >= LEAST:
            estimate = iqm_estimates({"": scores[:, None]})[""]
            row += [float(scores.std(ddof=1)), estimate.value, estimate.low, estimate.high]
        else:
            row += [None, iqm(scores[:, None]), None, None]
        row.append(fmean(known) if known else None)
    else:
        row += [len(runs), *[None] * 6]
    means = [fmean(getattr(run, name) for run in runs) for name in ("parameters", "flops")]
    return [*row, *map(round, means), first.dense_flops]


def runs_table(results: Results) -> Table:
    """Return a row for each run."""
    heads = ["folder", "algorithm", "environment", "method", "sparsity", "distribution", "seed"]
    heads += ["status", "timesteps", "evaluations", "score", "normalised", "parameters", "flops"]
    heads += ["dense flops", "compared"]
    main = {id(run) for run in results.main}
    rows = []
    for run in sorted(results.runs, key=lambda run: (*cell_of(run), run.seed, str(run.folder))):
        row: list[Any] = [str(run.folder), run.algo, run.env_id, run.label, run.level]
        row += [results.setting(run, "distribution"), run.seed, run.record["status"], run.steps]
        row += [len(run.returns), run.score if run.trained else None]
        row.append(results.normaliser(run) if run.trained else None)
        row += [run.parameters, run.flops, run.dense_flops, "yes" if id(run) in main else "no"]
        rows.append(row)
    return Table(heads, rows)


def findings_table(verdicts: Sequence[Verdict]) -> Table:
    """Return a row for each verdict as a page shows it, with its interval in one column."""
    heads = ["finding of the paper", "verdict", "effect [95 % interval]", "holds for", "unit"]
    heads += ["seeds", "comparisons", "seeds needed", "algorithm and tasks", "remark"]
    rows: list[list[Any]] = [
        [v.finding.text, v.verdict, _effect(v), v.holds or None, v.finding.unit, v.seeds or None]
        + [v.comparisons or None, v.needed, v.family, v.remark or None]
        for v in verdicts
    ]
    return Table(heads, rows, marks=MARKS)


def _effect(verdict: Verdict) -> Cell | None:
    return None if verdict.effect is None else Cell(verdict.effect, verdict.shown)


def verdicts_table(verdicts: Sequence[Verdict]) -> Table:
    """Return a row for each verdict."""
    heads = ["finding of the paper", "verdict", "effect", "low", "high", "holds for", "unit"]
    heads += ["seeds", "comparisons", "seeds needed", "algorithm and tasks", "remark"]
    rows: list[list[Any]] = [
        [v.finding.text, v.verdict, v.effect, v.low, v.high, v.holds, v.finding.unit]
        + [v.seeds, v.comparisons, v.needed, v.family or None, v.remark]
        for v in verdicts
    ]
    return Table(heads, rows, marks=MARKS)
