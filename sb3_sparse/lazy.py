"""Packages whose names are imported when somebody asks for them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazily(
    package: str, homes: Mapping[str, str], absent: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package that imports its modules as they are needed.

    So a light module in it, one that knows names for instance, can be imported without those that
    need torch. No name may be that of a module in the package: which of the two it is would depend
    on what was imported before.

    :param package: its ``__name__``
    :param homes: the module of each name, relative to the package, e.g. ``{"Study": "spec"}``
    :param absent: what to say of names that the package might be expected to have
    """

    def getattr_(name: str) -> Any:
        if name not in homes:
            usual = f"module {package!r} has no attribute {name!r}"
            raise AttributeError((absent or {}).get(name, usual))
        return getattr(import_module(f"{package}.{homes[name]}"), name)

    def dir_() -> list[str]:
        module = sys.modules[package]
        return sorted({*vars(module), *module.__all__})

    return getattr_, dir_
