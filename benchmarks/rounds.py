"""Interleaved rounds, so that a slow phase of the machine slows all contenders alike."""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def in_turn(steps: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[Any]]:
    """Run all steps in turn, ``rounds`` times after a warm-up; return their results by name."""
    found: dict[str, list[Any]] = {name: [] for name in steps}
    for _ in range(rounds + 1):
        for name, step in steps.items():
            found[name].append(step())
    return {name: values[1:] for name, values in found.items()}


def interleaved(steps: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Time all steps in turn, ``rounds`` times after a warm-up; return seconds by name."""

    def timed(step: Callable[[], Any]) -> Callable[[], float]:
        def run() -> float:
            start = time.perf_counter()
            step()
            return time.perf_counter() - start

        return run

    return in_turn({name: timed(step) for name, step in steps.items()}, rounds)


def listed(kind: Callable[[str], Any]) -> Callable[[str], list[Any]]:
    """Make an argparse type for values separated by commas."""

    def parts(text: str) -> list[Any]:
        try:
            return [kind(part) for part in text.split(",")]
        except ValueError:
            name = getattr(kind, "__name__", "value")
            message = f"expected values ({name}) separated by commas, got {text!r}"
            raise argparse.ArgumentTypeError(message) from None

    return parts


@contextmanager
def appending(path: Path, fields: list[str]) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Append rows to a CSV file immediately; a new file gets a header."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, fields)
        if new:
            writer.writeheader()

        def write(row: dict[str, Any]) -> None:
            writer.writerow(row)
            file.flush()

        yield write
