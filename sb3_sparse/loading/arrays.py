"""Reads NumPy archives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.loading.guard import reading


def read_arrays(
    path: Path, what: str, cure: str, needed: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Read all arrays in an ``.npz`` file by name. Nothing is unpickled.

    :param what: see :func:`~sb3_sparse.loading.guard.reading`
    :param cure: see :func:`~sb3_sparse.loading.guard.reading`
    :param needed: names of arrays of numbers or booleans that the file must hold
    :raises ConfigError: if the file cannot be opened
    :raises CorruptStateError: if the file holds something else
    """
    with reading(path, what, cure):
        content = np.load(path, allow_pickle=False)
        if not isinstance(content, np.lib.npyio.NpzFile):
            raise CorruptStateError(f"{path} is damaged, or holds no {what}: no archive; {cure}")
        with content:
            arrays = {name: np.asanyarray(content[name]) for name in content.files}
    for name in needed:
        if name not in arrays:
            raise CorruptStateError(f"{path} is damaged: {name} is missing; {cure}")
        if arrays[name].dtype.kind not in "biuf":
            raise CorruptStateError(
                f"{path} is damaged: {name} is of {arrays[name].dtype} where numbers should be; "
                f"{cure}"
            )
    return arrays
