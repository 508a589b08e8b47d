"""Operations on whole numbers, for processors without a float unit.

A value of the hidden layers is a vector of whole numbers ``q`` of up to 16 bits that stands for
``q * step``; 0 stands for 0. Sums have 32 bits, and nothing may overflow: whoever makes these nodes
sees to it that all bounds below hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.nodes import Floats, Node

MOST = 2**15 - 1
"""Largest absolute value of 16-bit whole numbers as they are used here."""
FRACTION = 15
"""Bits of a multiplier."""
PARTS = 256
"""Equal parts into which a table divides the range of its input."""
INSIDE = 65536 // PARTS
"""Whole numbers in each of these parts."""


@dataclass(frozen=True, eq=False)
class Quantize(Node):
    """Floats rounded to whole numbers: ``x * twice / 2``, halves away from 0, clipped to ``most``.

    :param twice: 2 divided by the step of each unit, float32, shape ``(units,)``
    :param most: largest absolute value of the result
    """

    twice: Floats
    most: int
    op = "quantize"
    whole = True

    def run(self, *inputs: NDArray[Any]) -> NDArray[Any]:
        """Compute the result for an input whose last axis is the batch."""
        bound = np.float32(2 * self.most)
        with np.errstate(over="ignore", invalid="ignore"):
            twice = inputs[0].astype(np.float32) * self.twice[:, None]
        twice = np.where(twice < bound, twice, bound)  # NaN, too
        twice = np.where(twice > -bound, twice, -bound)
        whole = np.trunc(twice).astype(np.int64)
        rounded: NDArray[np.int64] = np.sign(whole) * ((np.abs(whole) + 1) // 2)
        return rounded


@dataclass(frozen=True, eq=False)
class IntegerLinear(Node):
    """``weight @ x + bias`` in whole numbers; the sums of absolute values stay below 2^31.

    :param weight: 8-bit numbers, shape ``(outputs, inputs)``
    :param bias: 32-bit numbers, shape ``(outputs,)``
    """

    weight: NDArray[np.int8]
    bias: NDArray[np.int32]

    @property
    def nnz(self) -> int:
        """Number of connections that are not 0."""
        return int(np.count_nonzero(self.weight))

    def sums(self, x: NDArray[Any]) -> NDArray[np.int64]:
        """Return the sums; float64 holds whole numbers below 2^53 exactly, and is fast."""
        sums = self.weight.astype(np.float64) @ x.astype(np.float64) + self.bias[:, None]
        return sums.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Requantized(IntegerLinear):
    """A hidden layer: each sum, halved ``shift`` times and clipped, times ``multiplier / 2^15``.

    The bias of a row includes half of ``2^shift``, so that halving rounds.

    :param multiplier: below 2^15, shape ``(outputs,)``; also the largest result of a row
    :param shift: at most 30, shape ``(outputs,)``
    :param relu: whether negative results become 0
    """

    multiplier: NDArray[np.uint16]
    shift: NDArray[np.uint8]
    relu: bool
    op = "requantized"
    whole = True

    def run(self, *inputs: NDArray[Any]) -> NDArray[Any]:
        """Compute the result for an input whose last axis is the batch."""
        halved = self.sums(inputs[0]) >> self.shift[:, None].astype(np.int64)
        clipped = np.clip(halved, 0 if self.relu else -MOST, MOST)
        rounded = clipped * self.multiplier[:, None].astype(np.int64) + 2 ** (FRACTION - 1)
        result: NDArray[np.int64] = rounded >> FRACTION
        return result


@dataclass(frozen=True, eq=False)
class Dequantized(IntegerLinear):
    """A layer whose results are floats again: each sum times the scale of its row.

    :param scale: float32, shape ``(outputs,)``
    """

    scale: Floats
    op = "dequantized"

    def run(self, *inputs: NDArray[Any]) -> NDArray[Any]:
        """Compute the result for an input whose last axis is the batch."""
        return self.sums(inputs[0]).astype(np.float32) * self.scale[:, None]


@dataclass(frozen=True, eq=False)
class Lookup(Node):
    """An elementwise function by a table, with straight lines between its points.

    :param table: results at ``-32768, -32512, ..., 32768``, 16-bit numbers, shape ``(257,)``
    """

    table: NDArray[np.int16]
    op = "lookup"
    whole = True

    def run(self, *inputs: NDArray[Any]) -> NDArray[Any]:
        """Compute the result for an input whose last axis is the batch."""
        part, inside = np.divmod(inputs[0] + 32768, INSIDE)
        table = self.table.astype(np.int64)
        low, high = table[part], table[part + 1]
        result: NDArray[np.int64] = low + (((high - low) * inside + INSIDE // 2) >> 8)
        return result
