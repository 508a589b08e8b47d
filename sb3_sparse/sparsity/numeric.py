"""Checks of numeric arguments: Python's and NumPy's numbers count, booleans do not."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any

import numpy as np


def is_whole(value: Any) -> bool:
    """Whether ``value`` is a whole number, such as ``3`` or ``numpy.int64(3)``."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a number, such as ``0.5``, ``numpy.float32(0.5)``, infinity or NaN."""
    return isinstance(value, Real) and not isinstance(value, bool)


def as_float(value: Any) -> float:
    """Convert to a float as printed: ``numpy.float32(0.9)`` gives 0.9, not 0.8999999762."""
    return float(str(value)) if isinstance(value, np.floating) else float(value)
