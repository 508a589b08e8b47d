"""The callbacks that settings name besides the SparsityCallback."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sb3_sparse.errors import ConfigError

ROBUST_VALUE = "sb3_sparse.RobustValueCallback"


def robust_value_of(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the arguments of the RobustValueCallback; None if there is none.

    :param settings: in rl-zoo's form: a callback is a path, or a path with its arguments
    :raises ConfigError: if the arguments are no mapping
    """
    for path, arguments in named(settings):
        if path == ROBUST_VALUE:
            if not isinstance(arguments, Mapping):
                raise ConfigError(
                    f"{ROBUST_VALUE} takes a mapping of arguments, e.g. {{multi_step: 3}}, got "
                    f"{arguments!r}"
                )
            return dict(arguments)
    return None


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
    return [
        {ROBUST_VALUE: {**arguments, name: value}}
        if callback == ROBUST_VALUE or ROBUST_VALUE in callback
        else callback
        for callback in listed(settings)
    ]


def named(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the path and the arguments of each callback."""
    for callback in listed(settings):
        for path, arguments in ({callback: {}} if isinstance(callback, str) else callback).items():
            yield path, arguments or {}


def listed(settings: Mapping[str, Any]) -> list[Any]:
    """Return the callbacks as a list, whether they are one, several or none."""
    callbacks = settings.get("callback") or []
    return callbacks if isinstance(callbacks, list) else [callbacks]
