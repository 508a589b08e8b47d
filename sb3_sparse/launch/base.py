"""Tasks, their results, and the interface of launchers."""

from __future__ import annotations

import importlib
import pickle
import sys
from abc import ABC, abstractmethod
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError

POLL_SECONDS = 1.0


@dataclass(frozen=True)
class Task:
    """A function call to make in another process.

    :param name: name for messages
    :param function: ``"package.module:name"`` of the function; a path, so that the number of
        threads is set before anything is imported
    :param arguments: keyword arguments; must be picklable
    :param log: file that the output of the process is appended to; None: the output is dropped
    """

    name: str
    function: str
    arguments: Mapping[str, Any]
    log: Path | None = None

    def __call__(self) -> Any:
        """Make the call in this process."""
        module, _, name = self.function.partition(":")
        return getattr(importlib.import_module(module), name)(**self.arguments)

    def packed(self) -> bytes:
        """Return bytes for another process, including where this process finds its modules."""
        return pickle.dumps((list(sys.path), pickle.dumps(self)))

    @staticmethod
    def unpacked(content: bytes) -> Task:
        """Restore a task from :meth:`packed`, and find modules where that process found them."""
        path, task = pickle.loads(content)
        sys.path.extend(folder for folder in path if folder not in sys.path)
        found: Task = pickle.loads(task)
        return found


@dataclass(frozen=True)
class TaskResult:
    """The result of a task.

    :param task: the task
    :param value: the function's return value; None if it failed
    :param error: a message or traceback if it failed; None otherwise
    """

    task: Task
    value: Any = None
    error: str | None = None


class Launcher(ABC):
    """Runs tasks in processes of one thread each."""

    @abstractmethod
    def run(self, tasks: Sequence[Task], workers: int) -> Generator[TaskResult | None, None, None]:
        """Run the tasks in order; yield each result, and None after each second without one.

        A task that fails or whose process is killed does not affect the others. Closing the
        iterator asks running tasks to stop, waits for them, and starts no more.

        :param tasks: the tasks
        :param workers: number of tasks to run at a time, 1 or more
        """


def check_workers(workers: int) -> None:
    """Reject a number of workers below 1.

    :raises ConfigError: if ``workers`` is below 1
    """
    if workers < 1:
        raise ConfigError(f"workers must be 1 or more, got {workers}")
