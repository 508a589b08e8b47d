"""Files of measurements beside a run's evaluations: signal-to-noise ratios, noise, plasticity."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from sb3_sparse.errors import ConfigError
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.text import read_text

Rows = tuple[dict[str, str], ...]
TEXT = "name"
WHAT = "file of measurements"
CURE = "remove it, or measure anew"


def measured_text(path: Path) -> str:
    """Text of a file of measurements.

    :raises CorruptStateError: if it is no text
    """
    return read_text(path, WHAT, CURE)


def rows_of(text: str, path: Path, columns: Sequence[str]) -> Rows:
    """Rows of a CSV text that has at least these columns.

    :param path: of the file that it is of, for messages
    :raises ConfigError: if a column is missing, or a cell is no number
    :raises CorruptStateError: if it is no table
    """
    with reading(path, WHAT, CURE):
        reader = csv.DictReader(io.StringIO(text, newline=""))
        rows = tuple(reader)
        heads = reader.fieldnames or ()
    absent = [name for name in columns if name not in heads]
    if absent:
        raise ConfigError(f"{path.name} is damaged: it has no column {', '.join(absent)}")
    for number, row in enumerate(rows, start=2):
        for name in columns:
            if name != TEXT and not _is_number(row[name]):
                raise ConfigError(
                    f"{path.name} is damaged: {name} in line {number} is {row[name]!r}"
                )
    return rows


def _is_number(text: str | None) -> bool:
    try:
        return text is not None and not math.isinf(float(text))
    except ValueError:
        return False


def series(rows: Rows) -> dict[str, list[tuple[float, float]]]:
    """Points ``(timesteps, value)`` by name, in order; what is not a number is no point."""
    found: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        value = float(row["value"])
        if not math.isnan(value):
            found.setdefault(row["name"], []).append((float(row["timesteps"]), value))
    return {name: sorted(points) for name, points in found.items()}


def returns_by_sigma(rows: Rows) -> dict[float, float]:
    """Mean return over seeds and episodes at each strength of noise."""
    found: dict[float, list[float]] = {}
    for row in rows:
        value = float(row["return"])
        if not math.isnan(value):
            found.setdefault(float(row["sigma"]), []).append(value)
    return {sigma: sum(values) / len(values) for sigma, values in sorted(found.items())}
