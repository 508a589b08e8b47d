"""Files of measurements in a run's folder: signal-to-noise ratios, noise, plasticity."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from sb3_sparse.errors import ConfigError
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.text import read_text

Rows = tuple[dict[str, str], ...]
Points = list[tuple[float, float]]
SNR, PLASTICITY, NOISE = "snr.csv", "plasticity.csv", "robustness.csv"
OF_SNR = "snr/"  # begins the names of its series
TEXT = "name"
MEASURED = {
    SNR: ("timesteps", TEXT, "value"),
    PLASTICITY: ("timesteps", TEXT, "value"),
    NOISE: ("sigma", "seed", "episode", "return"),
}
"""Columns of each file of measurements."""
WHAT = "file of measurements"
CURE = "remove it, or measure again"


def measured_text(path: Path) -> str:
    """Read the text of a file of measurements.

    :raises CorruptStateError: if it is not text
    """
    return read_text(path, WHAT, CURE)


def rows_of(text: str, path: Path, columns: Sequence[str]) -> Rows:
    """Parse the rows of a CSV text that has at least these columns.

    :param path: path of the text's file, for messages
    :raises ConfigError: if a column is missing, or a cell is not a number
    :raises CorruptStateError: if it is not a table
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


def snr_by_network(measured: Mapping[str, Rows]) -> dict[str, Points]:
    """Return ``(timesteps, SNR)`` over all parameters of each network, active or not.

    :param measured: a run's rows by file name; without a file of ratios there is no network
    """
    found: dict[str, Points] = {}
    for row in measured.get(SNR, ()):
        network, value = row["name"].removeprefix(OF_SNR), float(row["value"])
        if network != row["name"] and "/" not in network and not math.isnan(value):
            found.setdefault(network, []).append((float(row["timesteps"]), value))
    return {network: sorted(points) for network, points in found.items()}


def returns_by_sigma(measured: Mapping[str, Rows]) -> dict[float, float]:
    """Return the mean return over seeds and episodes at each strength of noise.

    :param measured: a run's rows by file name; without a file of noise there is no strength
    """
    found: dict[float, list[float]] = {}
    for row in measured.get(NOISE, ()):
        value = float(row["return"])
        if not math.isnan(value):
            found.setdefault(float(row["sigma"]), []).append(value)
    return {sigma: sum(values) / len(values) for sigma, values in sorted(found.items())}
