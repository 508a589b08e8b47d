"""The names of methods and how they are drawn, the same in every figure."""

from __future__ import annotations

from sb3_sparse.pages.look import Look
from sb3_sparse.pages.names import METHODS

DENSE, EQUAL = "dense", "dense-equal"
NAMES = {
    DENSE: "Dense: 100 %",
    EQUAL: "Dense, equal parameters",
    **METHODS,
}


# Colours and markers are the paper's (IBM's colour-blind-safe palette) for what it compares. Line
# styles are added, so that no line is told by its colour alone.
LOOKS = {
    DENSE: Look("#444444", "X", "--"),
    EQUAL: Look("#648FFF", "s", "-."),
    "prune": Look("#DC267F", "D", ":"),
    "static": Look("#FFB000", ">", (0, (5, 1))),
    "set": Look("#FE6100", "<", "--"),
    "rigl": Look("#362682", "o", "-"),
    "granet": Look("#117733", "^", "-."),
    "mst": Look("#882255", "v", "--"),
    "rlx2": Look("#44AA99", "P", (0, (3, 1, 1, 1))),
}
OTHERS = (Look("#009E73", "^", "-"), Look("#56B4E9", "v", "--"), Look("#7F7F7F", "P", ":"))
# For levels of sparsity, budgets and regimes, from much to little; distinct in grey, too.
SHADES = ("#000000", "#785EF0", "#DC267F", "#FE6100", "#FFB000", "#009E73", "#56B4E9", "#999999")


def name_of(label: str) -> str:
    """Return a method's name in text."""
    return NAMES.get(label, label)


def look_of(label: str) -> Look:
    """Return how a method is drawn; a registered one looks the same in every figure, too."""
    if label in LOOKS:
        return LOOKS[label]
    return OTHERS[sum(label.encode()) % len(OTHERS)]


def shaded(label: str, place: int) -> Look:
    """Return a method's marker and line style in the colour of a level.

    :param place: place of the level among those that the figure compares
    """
    look = look_of(label)
    return Look(SHADES[place % len(SHADES)], look.marker, look.line)


def in_order(labels: set[str]) -> list[str]:
    """Sort methods: dense, those of the paper in its order, other shipped ones, then by name."""
    known = [label for label in NAMES if label in labels]
    return known + sorted(labels - set(known))


def percent(level: float) -> str:
    """Format a share, e.g. ``"90 %"``."""
    return f"{100 * level:.4g} %"
