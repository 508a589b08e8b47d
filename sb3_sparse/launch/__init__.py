"""Running tasks side by side: on this machine, or on a Ray cluster."""

from sb3_sparse.launch.base import Launcher, Task, TaskResult, check_workers
from sb3_sparse.launch.choice import launcher_named, launcher_names

__all__ = ["TaskResult", "Launcher", "Task", "check_workers", "launcher_named", "launcher_names"]
