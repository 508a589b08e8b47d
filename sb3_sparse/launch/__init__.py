"""Run tasks side by side, on this machine or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable

from sb3_sparse.errors import check_choice
from sb3_sparse.launch.base import Launcher, Task, TaskResult, check_workers
from sb3_sparse.launch.local import LocalLauncher
from sb3_sparse.launch.ray import RayLauncher

__all__ = ["LAUNCHERS", "Launcher", "Task", "TaskResult", "check_workers", "launcher_named"]

LAUNCHERS: dict[str, Callable[[str | None], Launcher]] = {
    "local": LocalLauncher,
    "ray": RayLauncher,
}
"""The launchers by name."""


def launcher_named(name: str, address: str | None = None) -> Launcher:
    """Return the launcher with this name.

    :param name: ``"local"``: processes of this machine; ``"ray"``: a Ray cluster
    :param address: address of the Ray cluster, e.g. ``"auto"`` or ``"ray://head:10001"``; None: a
        cluster of this machine alone
    :raises ConfigError: for an unknown name, or an address for a launcher other than Ray's
    :raises MissingExtra: for ``"ray"`` if Ray is not installed
    """
    check_choice("launcher", name, LAUNCHERS)
    return LAUNCHERS[name](address)
