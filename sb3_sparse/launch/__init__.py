"""Running tasks side by side: on this machine, or on a Ray cluster."""

from sb3_sparse.launch.base import Ended, Launcher, Task, check_workers
from sb3_sparse.launch.choice import launcher_named, launcher_names

__all__ = ["Ended", "Launcher", "Task", "check_workers", "launcher_named", "launcher_names"]
