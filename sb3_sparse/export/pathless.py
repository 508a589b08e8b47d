"""Pickles that do not contain the paths of source files."""

from __future__ import annotations

import io
import sys
from pathlib import PurePath
from types import CodeType, FunctionType
from typing import Any

import cloudpickle


def pickled(value: Any) -> bytes:
    """Pickle a value as SB3 does, functions by value included, without paths of source files."""
    file = io.BytesIO()
    _Pickler(file).dump(value)
    return file.getvalue()


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, FunctionType) and not _importable(obj):
            obj = _without_path(obj)
        return super().reducer_override(obj)


def _importable(function: FunctionType) -> bool:
    """Tell whether a function is pickled by name."""
    found: Any = sys.modules.get(function.__module__)
    if found is None or function.__module__ == "__main__":
        return False
    for name in function.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is function


def _without_path(function: FunctionType) -> FunctionType:
    names = {name: value for name, value in function.__globals__.items() if name != "__file__"}
    twin = FunctionType(
        _code(function.__code__),
        names,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    twin.__kwdefaults__ = function.__kwdefaults__
    twin.__qualname__ = function.__qualname__
    twin.__module__ = function.__module__
    twin.__dict__.update(function.__dict__)
    return twin


def _code(code: CodeType) -> CodeType:
    inner = (_code(part) if isinstance(part, CodeType) else part for part in code.co_consts)
    return code.replace(co_filename=PurePath(code.co_filename).name, co_consts=tuple(inner))
