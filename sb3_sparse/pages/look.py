"""How a line is told from others: by its colour, its marker and its line style."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Look:
    """The colour, marker and line style of a line, in matplotlib's terms."""

    color: str
    marker: str
    line: Any
