"""What a launcher is given, what it does, and what it gives back."""

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
    """A call to be made in a process of its own.

    :param name: for messages
    :param function: ``"package.module:name"`` of what is called; a path, so that the number of
        threads is set before anything is imported
    :param arguments: its keyword arguments; must pickle
    :param log: file that the process's output is appended to; None: dropped
    """

    name: str
    function: str
    arguments: Mapping[str, Any]
    log: Path | None = None

    def __call__(self) -> Any:
        """Make the call, here."""
        module, _, name = self.function.partition(":")
        return getattr(importlib.import_module(module), name)(**self.arguments)

    def packed(self) -> bytes:
        """Bytes for another process, with where this one finds its modules."""
        return pickle.dumps((list(sys.path), pickle.dumps(self)))

    @staticmethod
    def unpacked(content: bytes) -> Task:
        """The task of :meth:`packed`; modules are found where that process found them, too."""
        path, task = pickle.loads(content)
        sys.path.extend(folder for folder in path if folder not in sys.path)
        found: Task = pickle.loads(task)
        return found


@dataclass(frozen=True)
class TaskResult:
    """A task that is over.

    :param task: which
    :param value: what its function returned; None if it failed
    :param error: what went wrong, in words or as a traceback; None if nothing did
    """

    task: Task
    value: Any = None
    error: str | None = None


class Launcher(ABC):
    """Runs tasks in processes of one thread each, and never more than so many at a time."""

    @abstractmethod
    def run(self, tasks: Sequence[Task], workers: int) -> Generator[TaskResult | None, None, None]:
        """Run the tasks in their order; yields each that ends, and None once in a second without.

        A task that fails or whose process is killed takes no other with it. Closing the iterator
        asks the running ones to stop, waits for them, and starts no more.

        :param tasks: what is to be done
        :param workers: how many at a time, 1 or more
        """


def check_workers(workers: int) -> None:
    """Refuse a number of workers that is none.

    :raises ConfigError: if so
    """
    if workers < 1:
        raise ConfigError(f"workers must be 1 or more, got {workers}")
