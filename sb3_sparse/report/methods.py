"""What runs are called and how they are drawn: the same in every figure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

DENSE, EQUAL = "dense", "dense-equal"
SPARSE = ("prune", "static", "set", "rigl")
NAMES = {
    DENSE: "Dense: 100 %",
    EQUAL: "Dense, equal parameters",
    "prune": "Pruning",
    "static": "Static",
    "set": "SET",
    "rigl": "RigL",
}


@dataclass(frozen=True)
class Look:
    """Colour, marker and line style of one method."""

    color: str
    marker: str
    line: Any


# Colours and shapes are the paper's (its colours are IBM's colour-blind-safe palette); the line
# styles are added, so that nothing rests on colour alone.
LOOKS = {
    DENSE: Look("#444444", "X", "--"),
    EQUAL: Look("#648FFF", "s", "-."),
    "prune": Look("#DC267F", "D", ":"),
    "static": Look("#FFB000", ">", (0, (5, 1))),
    "set": Look("#FE6100", "<", "--"),
    "rigl": Look("#362682", "o", "-"),
}
OTHERS = (Look("#009E73", "^", "-"), Look("#56B4E9", "v", "--"), Look("#7F7F7F", "P", ":"))
# From much to little: levels of sparsity, budgets and regimes. Distinct in grey, too.
SHADES = ("#000000", "#785EF0", "#DC267F", "#FE6100", "#FFB000", "#009E73", "#56B4E9", "#999999")


def name_of(label: str) -> str:
    """What a method is called in text."""
    return NAMES.get(label, label)


def look_of(label: str) -> Look:
    """How a method is drawn; one of somebody else's keeps its look over all figures of a report."""
    if label in LOOKS:
        return LOOKS[label]
    return OTHERS[sum(label.encode()) % len(OTHERS)]


def shaded(label: str, place: int) -> Look:
    """A method's marker and line in the colour of a level, of those that a figure compares."""
    look = look_of(label)
    return Look(SHADES[place % len(SHADES)], look.marker, look.line)


def in_order(labels: set[str]) -> list[str]:
    """Dense first, then as the paper lists them, then all others by name."""
    known = [label for label in NAMES if label in labels]
    return known + sorted(labels - set(known))


def percent(level: float) -> str:
    """A share as text, e.g. ``"90 %"``."""
    return f"{100 * level:.4g} %"
