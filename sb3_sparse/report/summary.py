"""What a report found: a sentence, and a table of scores for each task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sb3_sparse.pages.numbers import counted, short, shorten
from sb3_sparse.pages.table import Cell, Table
from sb3_sparse.report.data import RunData
from sb3_sparse.report.methods import DENSE, EQUAL, headline, in_order, name_of, percent
from sb3_sparse.report.normalisation import possible_returns
from sb3_sparse.report.results import Results, grouped
from sb3_sparse.report.statistics import Estimate, mean
from sb3_sparse.report.values import order_of, shown_value

LEAST = 3
"""Seeds below which a mean has no interval here: that of two is mostly beyond possible returns."""
PLAIN = {DENSE: "dense", EQUAL: "dense with as many parameters"}


@dataclass(frozen=True)
class Scores:
    """The scores of one task.

    :param title: the task, with its algorithm if the report has several
    :param table: a row for each method
    :param note: what all entries have in common
    """

    title: str
    table: Table
    note: str


def sentences(results: Results) -> list[str]:
    """Say for each task how the best sparse method did beside dense networks.

    :return: a sentence for each task that has runs of a sparse method
    """
    found = []
    for family in results.families():
        sparse = [run for run in results.main if run.family == family and run.label not in PLAIN]
        for env_id in results.envs(family):
            here = [run for run in sparse if run.env_id == env_id]
            if here:
                level = headline({run.level for run in here})
                found.append(_sentence(results, family, env_id, level))
    return found


def _sentence(results: Results, family: str, env_id: str, level: float) -> str:
    runs = {
        label: results.cell(family, env_id, label, level) for label in results.labels(family, level)
    }
    means = {label: score_of(members, env_id) for label, members in runs.items() if members}
    methods = [label for label in means if label not in PLAIN]
    best = max(methods, key=lambda label: means[label].value)
    winners = " and ".join(name_of(label) for label in methods if means[label] == means[best])
    named = {best: winners, **{dense: PLAIN[dense] for dense in PLAIN if dense in means}}
    digits = _digits([means[label].value for label in named])
    seeds = {means[label].seeds for label in named}
    texts = [
        f"{name} {_interval(means[label], digits)}"
        + ("" if len(seeds) == 1 else f" ({counted(means[label].seeds, 'seed')})")
        for label, name in named.items()
    ]
    if len(methods) > 1:
        texts[0] += f", the highest mean of {len(methods)} sparse methods"
    end = f"; {counted(seeds.pop(), 'seed')}" if len(seeds) == 1 else ""
    return f"{task_of(results, family, env_id)} at {percent(level)}: {'; '.join(texts)}{end}."


def scores(results: Results) -> list[Scores]:
    """Return a table of each task: methods by sparsity, or by the setting that was varied."""
    found = []
    for family in results.families():
        for env_id in results.envs(family):
            cells = _by_setting(results, family, env_id) or _by_level(results, family, env_id)
            if cells:
                found.append(
                    _table(task_of(results, family, env_id), env_id, cells, results.varies)
                )
    return found


Row = tuple[str, float | None]
"""A method, and its sparsity unless that is the column."""
Entries = dict[Row, dict[Any, list[RunData]]]


def _by_level(results: Results, family: str, env_id: str) -> Entries:
    """Collect the runs that are compared, by method, and by sparsity."""
    found: Entries = {}
    for label in results.labels(family):
        for level in [0.0] if label == DENSE else results.levels(family):
            runs = results.cell(family, env_id, label, level)
            if runs:
                found.setdefault((label, None), {})[level] = runs
    return found


def _by_setting(results: Results, family: str, env_id: str) -> Entries:
    """Collect the runs by method and sparsity, and by the varied setting.

    :return: nothing if no setting was varied here
    """
    if results.varies is None:
        return {}
    here = [run for run in results.trained if (run.family, run.env_id) == (family, env_id)]
    found: Entries = {}
    for (_, _, label, level), members in grouped(here, _cell).items():
        for run in members:
            value = shown_value(results.setting(run, results.varies))
            found.setdefault((label, level), {}).setdefault(value, []).append(run)
    values = {value for row in found.values() for value in row}
    return found if len(values) > 1 else {}


def _cell(run: RunData) -> tuple[str, str, str, float]:
    return run.family, run.env_id, run.label, run.level


def _table(title: str, env_id: str, cells: Entries, varies: str | None) -> Scores:
    by_level = all(level is None for _, level in cells)
    columns = sorted({at for row in cells.values() for at in row}, key=order_of)
    means = {
        (row, at): score_of(runs, env_id) for row, by in cells.items() for at, runs in by.items()
    }
    seeds = {one.seeds for one in means.values()}
    texts, best = {}, set()
    for at in columns:
        here = {row: means[row, at] for row in cells if (row, at) in means}
        digits = _digits([one.value for one in here.values()])
        if len(here) > 1 and min(one.seeds for one in here.values()) >= LEAST:
            highest = max(one.value for one in here.values())
            best |= {(row, at) for row, one in here.items() if one.value == highest}
        for row, one in here.items():
            more = "" if len(seeds) == 1 else _of(one)
            texts[row, at] = f"{_interval(one, digits)}{more}"
    order = in_order({label for label, _ in cells})
    entries = {place: Cell(one.value, texts[place], place in best) for place, one in means.items()}
    rows = [
        [_named(*row), *(entries.get((row, at)) for at in columns)]
        for row in sorted(cells, key=lambda row: (order.index(row[0]), row[1] or 0.0))
    ]
    heads = [percent(at) if by_level else str(at) for at in columns]
    what = "by sparsity" if by_level else f"by {varies}"
    common = (
        f" over {counted(seeds.pop(), 'seed')}" if len(seeds) == 1 else ", with the number of seeds"
    )
    bold = (
        "; the highest of a column is bold, whether or not it can be told from others"
        if best
        else ""
    )
    note = f"Mean scores {what}{common}, 95 % Student t intervals from {LEAST} seeds on{bold}."
    return Scores(title, Table(["method", *heads], rows), note)


def score_of(runs: Sequence[RunData], env_id: str) -> Estimate:
    """Return the mean score, with an interval that holds no impossible return."""
    found = mean([run.score for run in runs])
    least, greatest = possible_returns(env_id)
    return Estimate(found.value, max(found.low, least), min(found.high, greatest), found.seeds)


def _interval(one: Estimate, digits: int) -> str:
    text = short(one.value, digits)
    if one.seeds < LEAST:
        return text
    return f"{text} [{short(one.low, digits)}; {short(one.high, digits)}]"


def _digits(values: Sequence[float]) -> int:
    """Return two digits, or three where values would tie that differ."""
    return 2 if shorten(values) == [short(value) for value in values] else 3


def _of(one: Estimate) -> str:
    return f" ({one.seeds})"


def _named(label: str, level: float | None) -> str:
    if level is None or label == DENSE:
        return name_of(label)
    return f"{name_of(label)}, {percent(level)}"


def task_of(results: Results, family: str, env_id: str) -> str:
    """Name a task, with its algorithm if there are several."""
    several = len(results.families()) > 1
    return f"{family.split(' on ', 1)[0]}, {env_id}" if several else env_id
