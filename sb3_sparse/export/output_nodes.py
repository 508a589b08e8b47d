"""The operations that only further outputs of a policy need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.nodes import Floats, Node, Pairwise


class Minimum(Pairwise):
    """The smaller of two values."""

    op = "minimum"


class Largest(Node):
    """The largest unit."""

    op = "largest"


@dataclass(frozen=True, eq=False)
class Constant(Node):
    """The same numbers for every observation, which is the input.

    :param numbers: shape ``(units,)``
    """

    numbers: Floats
    op = "constant"

    def fields(self) -> dict[str, NDArray[Any]]:
        return {"numbers": self.numbers[:, None].astype(np.float32)}
