"""What to say when something cannot be written."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_sparse.errors import Unwritable

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR)
LITTLE = 2**16  # bytes; PyTorch hides that a disk was full


def refusal(error: BaseException | None, folder: Path) -> str | None:
    """What a disk refused, if that is behind an error; None if it is something else.

    :param error: that writing has raised, itself or its causes
    :param folder: that was written to
    """
    torch = False
    while error is not None:
        if isinstance(error, OSError) and error.errno in (*FULL, *FORBIDDEN):
            return f"{error.filename or folder} cannot be written: {error.strerror}"
        torch = torch or "PytorchStreamWriter" in str(error)
        error = error.__cause__ or error.__context__
    if torch and shutil.disk_usage(folder).free < LITTLE:
        return f"{folder} cannot be written: the disk is full"
    return None


@contextmanager
def writing(folder: Path, cure: str) -> Iterator[None]:
    """Within it, what a disk refuses is said in one line.

    :param folder: that is written to
    :param cure: what to do then
    :raises Unwritable: if the disk is full or the folder cannot be written to
    """
    try:
        yield
    except OSError as error:
        refused = refusal(error, folder)
        if refused is None:
            raise
        raise Unwritable(f"{refused}; {cure}") from error
