"""The methods known by name."""

from __future__ import annotations

from typing import TypeVar

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.topology.base import TopologyMethod

_METHODS: dict[str, TopologyMethod] = {}
Method = TypeVar("Method", bound=TopologyMethod)


def register(cls: type[Method]) -> type[Method]:
    """Class decorator that makes a method known as ``cls.name``.

    :raises ConfigError: if another class has that name already
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
    """Where a class is defined; the same when its cell or module is run again."""
    return f"{cls.__module__}.{cls.__qualname__}"


def method_names() -> list[str]:
    """All registered names, sorted."""
    return sorted(_METHODS)


def method_named(name: str) -> TopologyMethod:
    """The method of that name.

    :raises ConfigError: if there is none
    """
    if not isinstance(name, str) or name not in _METHODS:
        raise ConfigError(
            f"unknown method {name!r}{did_you_mean(name, _METHODS)}; allowed are "
            f"{', '.join(method_names())}. A method of your "
            "own is a subclass of sb3_sparse.topology.TopologyMethod with @register on it"
        )
    return _METHODS[name]
