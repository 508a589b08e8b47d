"""The figures of a search."""

from __future__ import annotations

from sb3_sparse.pages.plot import styled
from sb3_sparse.tuning.figures.base import Picture
from sb3_sparse.tuning.figures.course import evaluations, history
from sb3_sparse.tuning.figures.importances import importances
from sb3_sparse.tuning.figures.values import by_value
from sb3_sparse.tuning.search import Search

__all__ = ["Picture", "pictures"]


def pictures(search: Search) -> list[Picture]:
    """Draw a search that has a completed trial.

    :return: its history, its evaluations, scores by value, and importances, in that order
    """
    with styled():
        return [draw(search) for draw in (history, evaluations, by_value, importances)]
