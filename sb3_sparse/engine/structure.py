"""The active connections of a weight, by rows and by columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.errors import CorruptStateError

Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
LIMIT = 2**31 - 65
"""The kernels index up to a tile ahead with 32 bits."""


class Structure:
    """Immutable compressed-row indices of a ``rows x columns`` weight, and their transpose.

    :param flat: flat indices of the active connections, ascending, shape ``(nnz,)``
    :param shape: ``(rows, columns)``, i.e. outputs and inputs
    :raises CorruptStateError: if an index is out of range, repeated or out of order
    """

    def __init__(self, flat: NDArray[Any], shape: tuple[int, int]) -> None:
        rows, columns = shape
        flat = np.asarray(flat, dtype=np.int64)
        if flat.ndim != 1 or (
            flat.size and (flat[0] < 0 or flat[-1] >= rows * columns or (np.diff(flat) <= 0).any())
        ):
            raise CorruptStateError(
                f"the indices of a {rows}x{columns} layer must ascend strictly within 0 to "
                f"{rows * columns - 1}; these do not"
            )
        if max(rows, columns, flat.size) > LIMIT:
            raise CorruptStateError(
                f"a {rows}x{columns} layer with {flat.size} connections is "
                f"beyond 32-bit indices; use compute='masked'"
            )
        self.shape = (int(rows), int(columns))
        self.nnz = int(flat.size)
        row, column = np.divmod(flat, columns)
        order = np.argsort(column, kind="stable")
        self.row_start = _starts(row, rows)
        self.column: Int32 = column.astype(np.int32)
        self.column_start = _starts(column[order], columns)
        self.row: Int32 = row[order].astype(np.int32)
        self.position: Int32 = order.astype(np.int32)
        """The row-major position of each connection of the transpose."""
        self._addresses: tuple[int, ...] | None = None

    @classmethod
    def of_mask(cls, mask: NDArray[Any], shape: tuple[int, int]) -> Structure:
        """Create the structure of a mask, True where active, of any shape with as many elements."""
        return cls(np.flatnonzero(mask), shape)

    def __deepcopy__(self, memo: dict[int, Any]) -> Structure:
        return self

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_addresses": None}

    @property
    def arrays(self) -> tuple[Int32, ...]:
        """Row starts and columns; column starts, rows and positions by columns."""
        return self.row_start, self.column, self.column_start, self.row, self.position

    @property
    def addresses(self) -> tuple[int, ...]:
        """Addresses of :attr:`arrays`, for the kernels."""
        if self._addresses is None:
            self._addresses = tuple(array.ctypes.data for array in self.arrays)
        return self._addresses

    @property
    def nbytes(self) -> int:
        """Bytes of the indices."""
        return sum(array.nbytes for array in self.arrays)

    @property
    def flat(self) -> Int64:
        """Flat indices of the active connections, ascending."""
        counts = np.diff(self.row_start)
        row = np.repeat(np.arange(self.shape[0], dtype=np.int64), counts)
        return row * self.shape[1] + self.column

    def equals(self, other: Structure) -> bool:
        """Whether both have the same connections."""
        return (
            self.shape == other.shape
            and np.array_equal(self.row_start, other.row_start)
            and np.array_equal(self.column, other.column)
        )

    def mask(self) -> NDArray[np.bool_]:
        """True where active, shape ``(rows * columns,)``."""
        mask = np.zeros(self.shape[0] * self.shape[1], dtype=np.bool_)
        mask[self.flat] = True
        return mask

    def places_in(self, other: Structure) -> Int64:
        """Find the position of each connection in ``other``; -1 if it is not there."""
        if not other.nnz:
            return np.full(self.nnz, -1, dtype=np.int64)
        mine, theirs = self.flat, other.flat
        places = np.searchsorted(theirs, mine)
        places[places == theirs.size] = 0
        places[theirs[places] != mine] = -1
        return places


def _starts(index: NDArray[Any], count: int) -> Int32:
    starts = np.zeros(count + 1, dtype=np.int32)
    np.cumsum(np.bincount(index, minlength=count), out=starts[1:])
    return starts
