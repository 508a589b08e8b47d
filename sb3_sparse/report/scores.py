"""Normalised scores of methods over the same tasks, as a panel compares them."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_sparse.report.data import Array
from sb3_sparse.report.methods import DENSE, in_order, name_of, percent
from sb3_sparse.report.statistics import LEAST, rectangle
from sb3_sparse.report.study import NotEnoughData, Study


def panel(study: Study, family: str, level: float) -> tuple[dict[str, Array], list[str], list[str]]:
    """Scores by method at one sparsity.

    A method is in it if it has two runs or more of some task; a task is in it if every such method
    has two or more runs of it. Of each task as many runs are taken as the scarcest task has.

    :return: arrays of shape ``[runs, tasks]``, the tasks, and what was left out
    """
    where = f"{family} at {percent(level)}"
    found: dict[str, dict[str, list[float]]] = {}
    remarks = []
    for label in study.labels(family, level):
        by_task = _by_task(study, family, label, level)
        if any(len(scores) >= LEAST for scores in by_task.values()):
            found[label] = by_task
        elif by_task:
            remarks.append(f"{where}: {name_of(label)} has fewer than {LEAST} runs of every task")
    if not set(found) - {DENSE}:
        return {}, [], remarks
    tasks = [
        task
        for task in study.envs(family)
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
    return scores, tasks, remarks


def panels_of(
    study: Study,
) -> tuple[list[tuple[str, float, dict[str, Array], list[str]]], list[str]]:
    """All panels ``(family, level, scores, tasks)`` with enough runs, and what was left out.

    :raises NotEnoughData: if there is none
    """
    found, remarks = [], []
    for family in study.families():
        for level in study.levels(family):
            scores, tasks, said = panel(study, family, level)
            remarks += said
            if scores:
                found.append((family, level, scores, tasks))
    if not found:
        raise NotEnoughData(_why_not(study, remarks))
    return found, remarks


def _why_not(study: Study, remarks: Sequence[str]) -> str:
    reasons = [*study.normaliser.missing, *dict.fromkeys(remarks)]
    first = "; ".join(reasons[:4]) + ("; and so on" if len(reasons) > 4 else "")
    return f"no sparsity has two runs or more of a method with normalised scores. {first}".strip()


def _by_task(study: Study, family: str, label: str, level: float) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for env_id in study.envs(family):
        scores = [study.normaliser(run) for run in study.cell(family, env_id, label, level)]
        known = [score for score in scores if score is not None]
        if known:
            found[env_id] = known
    return found
