"""Values of settings as figures and tables show and order them."""

from __future__ import annotations

from typing import Any


def shown_value(value: Any) -> Any:
    """Return a value as a tick of an axis or the head of a column."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(f"{value:.6g}")
    if isinstance(value, (list, tuple)):
        return ", ".join(map(str, value)) or "none"
    return str(value)


def order_of(value: Any) -> tuple[bool, float, str]:
    """Return what sorts values that :func:`shown_value` gave: numbers first."""
    number = value if isinstance(value, float) else 0.0
    return isinstance(value, str), number, str(value)
