"""The constant arrays of a policy in C."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np

from sb3_sparse.export.cheader import WIDTH

BYTES = {
    "float": 4,
    "int8_t": 1,
    "uint8_t": 1,
    "int16_t": 2,
    "uint16_t": 2,
    "int32_t": 4,
    "uint32_t": 4,
}


class Tables:
    """Collects arrays.

    :ivar texts: their definitions
    :ivar bytes: the space that they take
    """

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.bytes = 0

    def add(self, name: str, numbers: Any, kind: str) -> str:
        """Append an array, and return its name.

        :param kind: the type of its elements, one of :data:`BYTES`
        """
        flat = np.asarray(numbers).reshape(-1)
        if not flat.size:
            flat = np.zeros(1, flat.dtype)  # C has no arrays of length 0
        self.bytes += flat.size * BYTES[kind]
        texts = map(number, flat) if kind == "float" else map(str, flat.tolist())
        lines = textwrap.wrap(
            ", ".join(texts), WIDTH - 4, break_long_words=False, break_on_hyphens=False
        )
        body = "\n".join(f"    {line}" for line in lines)
        self.texts.append(f"static const {kind} {name}[{flat.size}] = {{\n{body}\n}};")
        return name


def number(value: Any) -> str:
    """Return the shortest literal that C reads back as the same float."""
    largest = np.finfo(np.float32).max  # C has no literal for infinity
    text = str(np.float32(np.clip(value, -largest, largest)))
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"
