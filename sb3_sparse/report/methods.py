"""The names of methods and how they are drawn, the same in every figure."""

from __future__ import annotations

from collections.abc import Iterable

from sb3_sparse.pages.look import Look
from sb3_sparse.pages.names import METHODS

DENSE, EQUAL = "dense", "dense-equal"
NAMES = {
    DENSE: "Dense",
    EQUAL: "Dense, equal parameters",
    **METHODS,
}
HEADLINE = 0.9
"""The sparsity that stands for all where there is room for one."""


# Colours are the paper's (IBM's colour-blind-safe palette) for what it compares, dense networks of
# full size are grey. Markers and line styles differ, so that no line is told by its colour alone.
LOOKS = {
    DENSE: Look("#6E6E6E", "X", "--"),
    EQUAL: Look("#648FFF", "s", "-."),
    "prune": Look("#DC267F", "D", ":"),
    "static": Look("#FFB000", "p", (0, (5, 1))),
    "set": Look("#FE6100", "P", "--"),
    "rigl": Look("#362682", "o", "-"),
    "granet": Look("#117733", "h", "-."),
    "mst": Look("#882255", "D", "--"),
    "rlx2": Look("#44AA99", "s", (0, (3, 1, 1, 1))),
}
OTHERS = (Look("#009E73", "p", "-"), Look("#56B4E9", "h", "--"), Look("#9A6324", "P", ":"))


def name_of(label: str) -> str:
    """Return a method's name in text."""
    return NAMES.get(label, label)


def look_of(label: str) -> Look:
    """Return how a method is drawn; a registered one looks the same in every figure, too."""
    if label in LOOKS:
        return LOOKS[label]
    return OTHERS[sum(label.encode()) % len(OTHERS)]


def in_order(labels: set[str]) -> list[str]:
    """Sort methods: dense, those of the paper in its order, other shipped ones, then by name."""
    known = [label for label in NAMES if label in labels]
    return known + sorted(labels - set(known))


def headline(levels: Iterable[float]) -> float:
    """Return the sparsity that stands for all: 90 %, or the nearest to it, of two the lower."""
    return min(levels, key=lambda level: (abs(level - HEADLINE), level))


def percent(level: float) -> str:
    """Format a share, e.g. ``"90 %"``."""
    return f"{100 * level:.4g} %"
