"""Launchers by name."""

from __future__ import annotations

from collections.abc import Callable

from sb3_sparse.errors import ConfigError
from sb3_sparse.launch.base import Launcher
from sb3_sparse.launch.local import LocalLauncher
from sb3_sparse.launch.ray import RayLauncher

_LAUNCHERS: dict[str, Callable[[str | None], Launcher]] = {
    "local": LocalLauncher,
    "ray": RayLauncher,
}


def launcher_names() -> list[str]:
    """All names."""
    return list(_LAUNCHERS)


def launcher_named(name: str, address: str | None = None) -> Launcher:
    """The launcher of that name.

    :param name: ``"local"``: processes of this machine; ``"ray"``: a Ray cluster
    :param address: of the Ray cluster, e.g. ``"auto"`` or ``"ray://head:10001"``; None: a cluster
        of this machine alone
    :raises ConfigError: for another name, or an address that is not Ray's
    :raises MissingExtra: for ``"ray"`` where Ray is not installed
    """
    if name not in _LAUNCHERS:
        raise ConfigError(f"unknown launcher {name!r}; allowed are {', '.join(_LAUNCHERS)}")
    return _LAUNCHERS[name](address)
