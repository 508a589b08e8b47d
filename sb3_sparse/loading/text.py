"""Reads text and JSON files. Needs nothing but Python."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.loading.guard import reading


def read_text(path: Path, what: str, cure: str) -> str:
    """Read a UTF-8 file, with or without a byte order mark.

    :param what: see :func:`~sb3_sparse.loading.guard.reading`
    :param cure: see :func:`~sb3_sparse.loading.guard.reading`
    :raises ConfigError: if the file cannot be opened
    :raises CorruptStateError: if the file is not UTF-8
    """
    with reading(path, what, cure):
        content = path.read_bytes()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CorruptStateError(
            f"{path} is not UTF-8 text (byte 0x{content[error.start]:02x} in line "
            f"{content.count(10, 0, error.start) + 1}); save it as UTF-8, or, if it is damaged, "
            f"{cure}"
        ) from error


def read_json(path: Path, what: str, cure: str) -> dict[str, Any]:
    """Read the mapping in a JSON file.

    :param what: see :func:`~sb3_sparse.loading.guard.reading`
    :param cure: see :func:`~sb3_sparse.loading.guard.reading`
    :raises ConfigError: if the file cannot be opened
    :raises CorruptStateError: if the file holds something else
    """
    text = read_text(path, what, cure)
    with reading(path, what, cure):
        content = json.loads(text)
    if not isinstance(content, dict):
        raise CorruptStateError(
            f"{path} is damaged, or holds no {what}: it is a {type(content).__name__} instead "
            f"of a mapping; {cure}"
        )
    return content
