"""Files that appear whole or not at all, and tables as CSV files."""

from __future__ import annotations

import csv
import math
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Replace a file at once, so that nobody ever sees half of it.

    Gives a name beside ``path`` to write to. At the end of the block that file is on the disk and
    takes the place of ``path``, with the permissions of the file before it; behind a link, it
    replaces what the link points to. If the block raises, ``path`` stays as it was.

    :param path: file to write; its folder must exist

    Example::

        with written_whole(Path("scores.txt")) as new:
            new.write_text("0.5")
    """
    target = path.resolve()
    # A name for each writer: two processes may write the same file at the same time.
    new = target.with_name(f"{target.name}.{secrets.token_hex(4)}.new")
    try:
        yield new
        if target.exists():
            shutil.copymode(target, new)
        sync(new)
        new.replace(target)
    except BaseException:
        new.unlink(missing_ok=True)  # half a file on a full disk
        raise


def sync(*paths: Path) -> None:
    """Wait until files and folders are on the disk, so that a power cut cannot lose them."""
    if os.name != "posix":
        return
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_csv(
    path: Path, heads: Sequence[str], rows: Iterable[Sequence[Any]], digits: int | None = None
) -> None:
    """Write a table as a CSV file, whole or not at all.

    :param path: file to write
    :param heads: names of the columns
    :param rows: an entry for each column; None leaves its field empty
    :param digits: significant digits of floats, and NaN leaves its field empty; None: floats are
        written so that reading gives the same ones back
    """
    with written_whole(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(heads)
        writer.writerows([_field(value, digits) for value in row] for row in rows)


def _field(value: Any, digits: int | None) -> Any:
    if digits is None or not isinstance(value, float):
        return value
    return "" if math.isnan(value) else f"{value:.{digits}g}"
