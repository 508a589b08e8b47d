"""The callbacks that settings name besides the SparsityCallback."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sb3_sparse.errors import ConfigError

ROBUST_VALUE = "sb3_sparse.RobustValueCallback"
OF_THIS_PACKAGE = ("RobustValueCallback", "RecycleDormantCallback", "ResetCallback")
"""Classes of ``sb3_sparse.callbacks``."""


def package_callback(path: str) -> str | None:
    """Return the name of a class of ``sb3_sparse.callbacks`` at a dotted path; None for others."""
    package, _, rest = path.partition(".")
    name = rest.rpartition(".")[2]
    return name if package == "sb3_sparse" and name in OF_THIS_PACKAGE else None


def package_callbacks(settings: Mapping[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the path, the name and the arguments of each callback of this package.

    :param settings: in rl-zoo's form: a callback is a path, or a path with its arguments
    :raises ConfigError: if the arguments are no mapping
    """
    for path, arguments in named(settings):
        name = package_callback(path)
        if name is None:
            continue
        if not isinstance(arguments, Mapping):
            raise ConfigError(
                f"{path} takes a mapping of arguments, e.g. {{verbose: 1}}, got {arguments!r}"
            )
        yield path, name, dict(arguments)


def robust_value_of(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the arguments of the RobustValueCallback; None if there is none.

    :param settings: in rl-zoo's form: a callback is a path, or a path with its arguments
    :raises ConfigError: if the arguments are no mapping
    """
    found = package_callbacks(settings)
    return next((given for _, name, given in found if name == OF_THIS_PACKAGE[0]), None)


def with_robust_value(settings: Mapping[str, Any], name: str, value: Any) -> list[Any]:
    """Return the list of callbacks with another value of an argument of the RobustValueCallback.

    :raises ConfigError: if there is no such callback
    """
    arguments = robust_value_of(settings)
    if arguments is None:
        raise ConfigError(
            f"{name} means nothing here: these settings train without {ROBUST_VALUE}; take "
            "--method rlx2, or name it under callback"
        )
    callbacks = list(listed(settings))
    for place, callback in enumerate(callbacks):
        path = callback if isinstance(callback, str) else next(iter(callback))
        if package_callback(path) == OF_THIS_PACKAGE[0]:
            callbacks[place] = {path: {**arguments, name: value}}
    return callbacks


def named(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the path and the arguments of each callback."""
    for callback in listed(settings):
        for path, arguments in ({callback: {}} if isinstance(callback, str) else callback).items():
            yield path, arguments or {}


def listed(settings: Mapping[str, Any]) -> list[Any]:
    """Return the callbacks as a list, whether they are one, several or none."""
    callbacks = settings.get("callback") or []
    return callbacks if isinstance(callbacks, list) else [callbacks]
