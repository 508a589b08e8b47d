"""The callbacks that settings name, in rl-zoo's form: a path, or a path with its arguments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.arguments import import_path

CALLBACK = "sb3_sparse.SparsityCallback"
ROBUST_VALUE = "RobustValueCallback"
OF_THIS_PACKAGE = (ROBUST_VALUE, "RecycleDormantCallback", "ResetCallback")
"""Classes of ``sb3_sparse.callbacks``."""


def package_callback(path: str) -> str | None:
    """Return the name of a class of ``sb3_sparse.callbacks`` at a dotted path; None for others."""
    package, _, rest = path.partition(".")
    name = rest.rpartition(".")[2]
    return name if package == "sb3_sparse" and name in OF_THIS_PACKAGE else None


def package_callbacks(settings: Mapping[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the path, the name and the arguments of each callback of this package.

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

    :raises ConfigError: if the arguments are no mapping
    """
    found = package_callbacks(settings)
    return next((given for _, name, given in found if name == ROBUST_VALUE), None)


def with_robust_value(settings: Mapping[str, Any], name: str, value: Any) -> list[Any]:
    """Return the list of callbacks with another value of an argument of the RobustValueCallback.

    :raises ConfigError: if there is no such callback
    """
    arguments = robust_value_of(settings)
    if arguments is None:
        raise ConfigError(
            f"{name} means nothing here: these settings train without sb3_sparse.{ROBUST_VALUE}; "
            "take --method rlx2, or name it under callback"
        )
    callbacks = list(listed(settings))
    for place, callback in enumerate(callbacks):
        path = callback if isinstance(callback, str) else next(iter(callback))
        if package_callback(path) == ROBUST_VALUE:
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


def sparsity_callback(
    settings: Mapping[str, Any], imports: bool
) -> tuple[bool, dict[str, Any]] | None:
    """Return whether the SparsityCallback is a user's subclass, and its arguments.

    :param imports: whether paths may be imported to identify them; else a callback with a
        ``method`` counts as one
    :return: None if there is none
    :raises ConfigError: if a callback has another form, or lacks its method
    """
    for callback in listed(settings):
        entry = callback if isinstance(callback, dict) else {callback: {}}
        if len(entry) != 1:
            raise ConfigError(
                f"a callback is one path, with its arguments indented below it, got {callback!r}"
            )
        ((path, arguments),) = entry.items()
        has_method = isinstance(arguments, dict) and "method" in arguments
        own = is_own(path) if imports or path == CALLBACK else has_method or None
        if own is not None:
            if not has_method:
                raise ConfigError(f"{path} needs a method, e.g. {path}: {{method: rigl}}")
            return own, arguments
    return None


def is_own(path: object) -> bool | None:
    """Return True for a subclass of SparsityCallback, False for itself, None for other paths."""
    if not isinstance(path, str):
        raise ConfigError(f"a callback is a dotted path, e.g. {CALLBACK}, got {path!r}")
    if path == CALLBACK:
        return False
    from sb3_sparse.callback import SparsityCallback

    try:
        found = import_path(path)
    except ImportError:
        return None  # rl-zoo reports this when it imports the callback
    ours = isinstance(found, type) and issubclass(found, SparsityCallback)
    return found is not SparsityCallback if ours else None
