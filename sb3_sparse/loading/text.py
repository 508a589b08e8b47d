"""Text files, JSON among them. Needs nothing but Python."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.loading.guard import reading


def read_text(path: Path, what: str, cure: str) -> str:
    """The text in a UTF-8 file, with or without a byte order mark.

    :param what: as of :func:`~sb3_sparse.loading.guard.reading`
    :param cure: as of :func:`~sb3_sparse.loading.guard.reading`
    :raises ConfigError: if it cannot be opened
    :raises CorruptStateError: if it is not UTF-8
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
    """The mapping in a JSON file.

    :param what: as of :func:`~sb3_sparse.loading.guard.reading`
    :param cure: as of :func:`~sb3_sparse.loading.guard.reading`
    :raises ConfigError: if it cannot be opened
    :raises CorruptStateError: if it holds something else
    """
    text = read_text(path, what, cure)
    with reading(path, what, cure):
        content = json.loads(text)
    if not isinstance(content, dict):
        raise CorruptStateError(
            f"{path} is damaged, or is no {what}: it holds a {type(content).__name__} where a "
            f"mapping should be; {cure}"
        )
    return content
