"""Explains why a file or folder cannot be written."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sb3_sparse.errors import Unwritable

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR)
LITTLE = 2**16  # bytes free; PyTorch does not report that a disk is full


def refusal(error: BaseException | None, folder: Path) -> str | None:
    """Return why the disk caused an error; None if something else did.

    :param error: the error that writing raised; its causes are searched too
    :param folder: the folder being written to
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
    """Report errors of the disk in one line.

    :param folder: the folder being written to
    :param cure: what to do about it, for the message
    :raises Unwritable: if the disk is full or the folder is not writable
    """
    try:
        yield
    except OSError as error:
        refused = refusal(error, folder)
        if refused is None:
            raise
        raise Unwritable(f"{refused}; {cure}") from error
