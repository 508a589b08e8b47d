"""Normalised scores of methods over the same tasks, one panel for each sparsity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sb3_sparse.report.data import Array
from sb3_sparse.report.methods import DENSE, in_order, name_of, percent
from sb3_sparse.report.results import NotEnoughData, Results
from sb3_sparse.report.statistics import LEAST, rectangle


@dataclass(frozen=True)
class Panel:
    """Normalised scores of the methods of one family at one sparsity.

    :param family: algorithm and tasks
    :param level: sparsity
    :param scores: arrays of shape ``[runs, tasks]``, by method
    :param tasks: the columns
    """

    family: str
    level: float
    scores: Mapping[str, Array]
    tasks: Sequence[str]


def panels_of(results: Results) -> tuple[list[Panel], list[str]]:
    """Collect every panel that has enough runs.

    :return: the panels, and remarks on what was left out
    :raises NotEnoughData: if no panel has
    """
    found, remarks = [], []
    for family in results.families():
        for level in results.levels(family):
            panel, said = _panel(results, family, level)
            remarks += said
            if panel is not None:
                found.append(panel)
    if not found:
        raise NotEnoughData(_why_not(results, remarks))
    return found, remarks


def _panel(results: Results, family: str, level: float) -> tuple[Panel | None, list[str]]:
    """Collect the scores at one sparsity, and remarks on what was left out.

    A method is in it if it has two runs or more of some task; a task is in it if every such method
    has two or more runs of it. Each task gives as many runs as the scarcest task has.
    """
    where = f"{family} at {percent(level)}"
    found: dict[str, dict[str, list[float]]] = {}
    remarks = []
    for label in results.labels(family, level):
        by_task = _by_task(results, family, label, level)
        if any(len(scores) >= LEAST for scores in by_task.values()):
            found[label] = by_task
        elif by_task:
            remarks.append(f"{where}: {name_of(label)} has fewer than {LEAST} runs of every task")
    if not set(found) - {DENSE}:
        return None, remarks
    tasks = [
        task
        for task in results.envs(family)
        if all(len(by_task.get(task, ())) >= LEAST for by_task in found.values())
    ]
    dropped = {task for by_task in found.values() for task in by_task} - set(tasks)
    remarks += [f"{where}: {task} lacks runs of some method" for task in sorted(dropped)]
    scores = {}
    for label in in_order(set(found)):
        given = rectangle({task: found[label][task] for task in tasks})
        if given is not None:
            scores[label] = given.scores
            remarks += [f"{where}: {name_of(label)}, {text}" for text in given.remarks]
    return Panel(family, level, scores, tasks) if scores else None, remarks


def _why_not(results: Results, remarks: Sequence[str]) -> str:
    reasons = [*results.normaliser.missing, *dict.fromkeys(remarks)]
    first = "; ".join(reasons[:4]) + ("; and so on" if len(reasons) > 4 else "")
    return f"no sparsity has two runs or more of a method with normalised scores. {first}".strip()


def _by_task(results: Results, family: str, label: str, level: float) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for env_id in results.envs(family):
        scores = [results.normaliser(run) for run in results.cell(family, env_id, label, level)]
        known = [score for score in scores if score is not None]
        if known:
            found[env_id] = known
    return found
