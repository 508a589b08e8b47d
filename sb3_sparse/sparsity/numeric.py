"""What counts as a number in an argument: Python's and NumPy's, but no boolean."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

import numpy as np


def is_whole(value: Any) -> bool:
    """Whether it is a whole number, as ``3`` or ``numpy.int64(3)``."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether it is a number, as ``0.5`` or ``numpy.float32(0.5)``; infinity and NaN are."""
    return isinstance(value, Real) and not isinstance(value, bool)


def as_float(value: Any) -> float:
    """The number as the user sees it: ``numpy.float32(0.9)`` is 0.9 and not 0.8999999762."""
    return float(str(value)) if isinstance(value, np.floating) else float(value)
