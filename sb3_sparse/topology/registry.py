"""The registry of methods by name."""

from __future__ import annotations

from typing import TypeVar

from sb3_sparse.errors import ConfigError, check_choice
from sb3_sparse.topology.base import TopologyMethod

_METHODS: dict[str, TopologyMethod] = {}
Method = TypeVar("Method", bound=TopologyMethod)


def register(cls: type[Method]) -> type[Method]:
    """Class decorator: register a method under ``cls.name``.

    :raises ConfigError: if the class has no name, or if another class has the same one
    """
    name = getattr(cls, "name", None)
    if not isinstance(name, str) or not name:
        raise ConfigError(f'{cls.__qualname__} needs a class attribute `name`, e.g. name = "mine"')
    known = _METHODS.get(name)
    if known is not None and _address(type(known)) != _address(cls):
        raise ConfigError(
            f"the method name {name!r} is taken by {_address(type(known))}; choose another"
        )
    _METHODS[name] = cls()
    return cls


def _address(cls: type) -> str:
    """Where a class is defined; running its notebook cell or module again keeps it."""
    return f"{cls.__module__}.{cls.__qualname__}"


def method_names() -> list[str]:
    """The registered names, sorted."""
    return sorted(_METHODS)


def method_named(name: str) -> TopologyMethod:
    """Look up a method.

    :raises ConfigError: if no method has that name
    """
    hint = (
        ". A method of your own is a subclass of sb3_sparse.topology.TopologyMethod with @register "
        "on it; presets, such as mst, are for --method alone"
    )
    check_choice("method", name, method_names(), hint)
    return _METHODS[name]
