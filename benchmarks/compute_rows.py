"""Rows of sparse_compute.py: what is measured of a variant, and tables of them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

FIELDS = ["what", "case", "batch", "sparsity", "variant", "milliseconds", "speedup", "megabytes"]


def rows_of(
    what: str, case: str, batch: int, sparsity: float, times: dict[str, list[float]], count: int
) -> Iterator[dict[str, Any]]:
    """Make a row of the CSV file for each variant; the others are compared to the first.

    :param count: steps in each timing
    """
    base = next(iter(times.values()))
    for name, found in times.items():
        yield {
            "what": what,
            "case": case,
            "batch": batch,
            "sparsity": sparsity,
            "variant": name,
            "milliseconds": 1e3 * median(found) / count,
            "speedup": median(a / b for a, b in zip(base, found, strict=True)),
        }


def line(row: dict[str, Any]) -> str:
    """Format a row for reading."""
    size = f"  {row['megabytes']:8.2f} MB" if "megabytes" in row else ""
    return (
        f"{row['what']:<7} {row['case']:<26} batch {row['batch']:>3}  {row['sparsity']:.0%}  "
        f"{row['variant']:<20} {row['milliseconds']:9.3f} ms  {row['speedup']:6.2f}x{size}"
    )


def print_tables(rows: list[dict[str, str]]) -> None:
    """Print rows as Markdown: a line for each case, a column for each variant."""
    for what in dict.fromkeys(row["what"] for row in rows):
        found: dict[tuple[str, ...], dict[str, dict[str, str]]] = {}
        for row in rows:
            if row["what"] == what:
                name = re.sub(r" \d+$", "", row["variant"])  # narrow dense 75
                key = (row["case"], row["batch"], f"{float(row['sparsity']):.0%}")
                found.setdefault(key, {})[name] = row
        variants = list(dict.fromkeys(name for case in found.values() for name in case))
        base, *others = variants
        print(f"| {what} | batch | sparsity | {base}, ms | {' | '.join(others)} | MB |")
        print("|---" * (len(variants) + 4) + "|")
        for key, case in found.items():
            cells = [f"{float(case[base]['milliseconds']):.3g}"]
            cells += [f"{float(case[o]['speedup']):.2f}" if o in case else "" for o in others]
            sizes = [case[v]["megabytes"] for v in ("dense, stock", "masked", "auto") if v in case]
            cells.append(" / ".join(f"{float(size):.3g}" for size in sizes if size))
            print("| " + " | ".join([*key, *cells]) + " |")
        print()


def read(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
