"""Clips and scales actions, in one call of the kernels each."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from sb3_sparse.engine.buffer import FLOAT, FloatBuffer
from sb3_sparse.engine.native.library import library

Array = NDArray[Any]
CLIP, UNSCALE, SCALE = range(3)


class Bounds:
    """Lowest and highest actions, ready for the kernels. Copies and pickles of it are None.

    :param low: lowest actions, float32
    :param high: highest actions, float32, of the same shape
    """

    def __init__(self, low: Array, high: Array) -> None:
        self.low, self.high = low, high
        self._shape, self._size = low.shape, low.size
        self._places = low.ctypes.data, high.ctypes.data
        self._call = library().sb3_sparse_box

    def __reduce__(self) -> Any:
        return type(None), ()

    @staticmethod
    def readable(low: Array, high: Array) -> bool:
        """Whether the kernels can read these bounds."""
        return all(
            bound.dtype == FLOAT and bound.flags.c_contiguous and bound.shape == low.shape
            for bound in (low, high)
        )

    def of(self, actions: Array, how: int) -> Array | None:
        """Clip or scale actions as NumPy would; None unless they are float32 of the right shape.

        :param actions: one action, or shape ``(n, *shape of one)``
        :param how: ``CLIP`` to the bounds; ``UNSCALE`` from [-1, 1] to them; ``SCALE`` back
        """
        shape = actions.shape
        if actions.dtype != FLOAT or (shape[1:] != self._shape and shape != self._shape):
            return None
        buffer = FloatBuffer(actions.size)
        self._call(how, actions.size, self._size, *self._places, actions.tobytes(), buffer.memory)
        return buffer.array(shape)
