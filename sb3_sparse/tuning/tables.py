"""The tables of a search's page: its best trials, and the best of each method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sb3_sparse.errors import SparsityError
from sb3_sparse.pages import html
from sb3_sparse.pages.numbers import short
from sb3_sparse.pages.table import Cell, Table
from sb3_sparse.sparsity.numeric import is_number
from sb3_sparse.tuning.backend import BaseStorage, optuna
from sb3_sparse.tuning.definition import Definition
from sb3_sparse.tuning.search import DEFINITION, Search
from sb3_sparse.tuning.values import best_of, score_of, spelled, value_text, varied
from sb3_sparse.tuning.words import DIGITS, in_words, what

TOP = 10


def best_trials(search: Search) -> tuple[str, list[str]]:
    """Make a table of the best trials; what is the same in all of them is said below it.

    :return: its title, and the table with what is said
    """
    best = sorted(search.status().complete, key=lambda trial: -score_of(trial))[:TOP]
    columns: dict[str, Sequence[Any]] = {
        "trial": [trial.number for trial in best],
        "score": _scores([score_of(trial) for trial in best]),
    }
    if search.definition.seeds > 1:
        seeds = (trial.user_attrs.get("scores", []) for trial in best)
        columns["score of each seed"] = [
            ", ".join(short(score, DIGITS) for score in scores) for scores in seeds
        ]
    for name in varied(search):
        columns[spelled(name)] = [_value(trial.params.get(name)) for trial in best]
    title = "The best trial" if len(best) == 1 else f"The {len(best)} best trials"
    return title, _table(columns)


def best_by_method(searches: Sequence[Search], storage: BaseStorage) -> tuple[list[str], list[str]]:
    """Compare the best trials of all searches in a storage that had the same task.

    :return: a table and what is said below it, nothing if there is nothing to compare; which
        searches could not be read, and why
    """
    tasks = {_task(search.definition) for search in searches}
    found, unread = [], []
    for summary in storage.get_all_studies():
        if DEFINITION not in summary.user_attrs:
            continue
        search = Search(optuna.load_study(storage=storage, study_name=summary.study_name))
        try:
            definition = search.definition
        except SparsityError as error:  # e.g. of an environment or method that is missing here
            unread.append(f"Left out: {summary.study_name}: {error}")
            continue
        if _task(definition) in tasks and search.status().best is not None:
            found.append(search)
    if len(found) < 2:
        return [], unread
    found.sort(key=lambda search: (_task(search.definition), -score_of(best_of(search))))
    definitions = [search.definition for search in found]
    tasks_of = [_task(definition) for definition in definitions]
    status = [search.status() for search in found]
    columns: dict[str, Sequence[Any]] = {
        "algorithm": [algo.upper() for algo, _, _ in tasks_of],
        "environment": [env_id for _, env_id, _ in tasks_of],
        "steps": [steps for _, _, steps in tasks_of],
        "method": [
            what(search.definition, best_of(search)).replace(" %", "\u00a0%") for search in found
        ],
        "best score": _scores([score_of(best_of(search)) for search in found], tasks_of),
        "with": [in_words(search, best_of(search)) for search in found],
        "completed": [f"{len(one.complete)} of {one.planned}" for one in status],
        "seeds per trial": [definition.seeds for definition in definitions],
        "search": [search.name for search in found],
    }
    return _table(columns), unread


def _table(columns: Mapping[str, Sequence[Any]]) -> list[str]:
    rows = list(zip(*columns.values(), strict=True))
    table, same = Table(list(columns), rows).varying()
    texts = "; ".join(f"{head} {_text(value)}" for head, value in same.items())
    said = [html.paragraph(f"The same in all rows: {texts}.")] if same else []
    return [html.table(table), *said]


def _scores(scores: Sequence[float], groups: Sequence[Any] | None = None) -> list[Cell]:
    """Make cells of scores; the best of each group stands out."""
    groups = groups or [None] * len(scores)
    best = {
        group: max(score for score, other in zip(scores, groups, strict=True) if other == group)
        for group in groups
    }
    return [
        Cell(score, short(score, DIGITS), strong=score == best[group])
        for score, group in zip(scores, groups, strict=True)
    ]


def _value(value: Any) -> Any:
    if isinstance(value, float):
        return Cell(value, value_text(value))
    return value if value is None or is_number(value) else value_text(value)


def _text(value: Any) -> str:
    return value.text if isinstance(value, Cell) else value_text(value)


def _task(definition: Definition) -> tuple[str, str, int]:
    run = definition.run
    return run.algo, run.env_id, run.settings()["n_timesteps"]
