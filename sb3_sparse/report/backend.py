"""rliable, an optional dependency: every module imports it from here."""

from __future__ import annotations

from sb3_sparse.errors import MissingExtra

try:
    from rliable import library as rliable_library
except ImportError as error:
    raise MissingExtra("reports on runs", "report") from error

__all__ = ["rliable_library"]
