"""The inputs of a program: tensors, or rows of arrays that are read in place."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_sparse.fused.errors import NotCovered

TYPES = {
    "float32": 0, "float64": 1, "int64": 2, "int32": 3, "uint8": 4, "bool": 4, "int8": 5
}  # fmt: skip
Array = NDArray[Any]


@cache
def _name(dtype: th.dtype) -> str:
    return str(dtype).removeprefix("torch.")


class Inputs:
    """Owns the table of ``input_t`` of ``fused.h``, one entry for each input of a program.

    :param rows: name and number of features of each input
    """

    def __init__(self, rows: Sequence[tuple[str, int]]) -> None:
        self._numbers = {name: number for number, (name, _) in enumerate(rows)}
        self._features = dict(rows)
        self._table: Any = (ctypes.c_int64 * max(1, 4 * len(rows)))()
        self._held: dict[str, Any] = {}

    @property
    def address(self) -> int:
        """Address of the table."""
        return ctypes.addressof(self._table)

    def load(self, rows: Mapping[str, th.Tensor]) -> int:
        """Read inputs from tensors; return the batch size.

        :param rows: tensors by name, ``(batch, features)``, or ``(batch,)`` for one feature
        :raises NotCovered: if a shape does not fit
        """
        batch = 0
        for name, tensor in rows.items():
            if name not in self._numbers:
                continue
            kind = _name(tensor.dtype)
            if kind not in TYPES:
                tensor, kind = tensor.float(), "float32"
            if not tensor.is_contiguous():
                tensor = tensor.contiguous()
            if batch not in (0, len(tensor)):
                raise NotCovered("inputs of different batch sizes")
            batch = len(tensor)
            self._put(name, tensor.data_ptr(), kind, tensor.numel() // max(1, batch), 0)
            self._held[name] = tensor
        return batch

    def point(self, arrays: Mapping[str, tuple[Array, int]], lead: int) -> None:
        """Read inputs from rows of arrays, in place.

        :param arrays: arrays by name, each with the address of its row numbers, int64
        :param lead: number of leading dimensions that are not features
        :raises NotCovered: if a type or shape does not fit
        """
        for name, (array, index) in arrays.items():
            number = self._numbers.get(name)
            if number is None:
                continue
            if self._held.get(name) is array:
                self._table[4 * number + 3] = index
                continue
            if not array.flags.c_contiguous:
                raise NotCovered(f"{name} in an array that is not contiguous")
            features = int(np.prod(array.shape[lead:], dtype=np.int64))
            self._put(name, array.ctypes.data, array.dtype.name, features, index)
            self._held[name] = array

    def _put(self, name: str, address: int, kind: str, features: int, index: int) -> None:
        if kind not in TYPES or features != self._features[name]:
            raise NotCovered(f"{name} of {features} numbers of type {kind}")
        number = 4 * self._numbers[name]
        self._table[number : number + 4] = [address, TYPES[kind], features, index]
