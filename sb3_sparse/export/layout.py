"""Orders the weights of a layer for C, and chooses how they are stored."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.ckernels import GROUP, INDEX_TYPES


def index_bits(columns: int, longest: int) -> int:
    """Return the bits of a layer's indices and of the lengths of its rows.

    :param columns: number of inputs
    :param longest: most connections of a row
    """
    return next(bits for bits in INDEX_TYPES if max(columns - 1, longest) < 2**bits)


def is_smaller_dense(rows: NDArray[Any], width: int, bits: int) -> bool:
    """Tell whether all weights take no more bytes than those that are not 0, with their indices.

    :param width: bytes of a weight
    :param bits: bits of an index
    """
    return bool(rows.size * width <= np.count_nonzero(rows) * (width + bits // 8))


def grouped(rows: NDArray[Any]) -> tuple[list[int], NDArray[Any], NDArray[Any]]:
    """Return lengths, columns and values in the order in which ``linear`` reads them.

    Rows of a group are padded to the longest one with zeros, at a column that they already have.
    """
    lengths: list[int] = []
    columns: list[NDArray[Any]] = []
    values: list[NDArray[Any]] = []
    together = len(rows) - len(rows) % GROUP
    for first in [*range(0, together, GROUP), *range(together, len(rows))]:
        group = rows[first : first + (GROUP if first < together else 1)]
        active = [np.flatnonzero(row) for row in group]
        longest = max(map(len, active))
        lengths.append(longest)
        column = np.zeros((longest, len(group)), np.int64)
        value = np.zeros((longest, len(group)), rows.dtype)
        for lane, (row, found) in enumerate(zip(group, active, strict=True)):
            column[: len(found), lane] = found
            column[len(found) :, lane] = found[-1] if found.size else 0
            value[: len(found), lane] = row[found]
        columns.append(column.reshape(-1))
        values.append(value.reshape(-1))
    return lengths, np.concatenate(columns), np.concatenate(values)


def side_by_side(rows: NDArray[Any]) -> NDArray[Any]:
    """Return the values of a dense layer in the order in which ``linear_dense`` reads them."""
    together = len(rows) - len(rows) % GROUP
    groups = [rows[first : first + GROUP].T.reshape(-1) for first in range(0, together, GROUP)]
    return np.concatenate([*groups, rows[together:].reshape(-1)])
