"""Packages that import their names on first access."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import getsource
from typing import Any


def lazily(
    package: str, absent: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package that imports its modules as they are needed.

    Light modules of the package can thus be imported without torch. The names, and the modules that
    define them, are those of its ``if TYPE_CHECKING`` imports. No name may be that of a module of
    the package: what it meant would then depend on earlier imports.

    :param package: its ``__name__``
    :param absent: messages for names that users may expect but the package lacks
    """
    homes = {
        alias.name: node.module
        for block in ast.parse(getsource(sys.modules[package])).body
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names
    }

    def getattr_(name: str) -> Any:
        if name not in homes:
            usual = f"module {package!r} has no attribute {name!r}"
            raise AttributeError((absent or {}).get(name, usual))
        return getattr(import_module(homes[name]), name)

    def dir_() -> list[str]:
        module = sys.modules[package]
        return sorted({*vars(module), *module.__all__})

    return getattr_, dir_
