"""What a process that forks is told to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Job:
    """A task with its files.

    :param packed: the task, as :meth:`Task.packed` makes it
    :param log: that all output is appended to
    :param answer: that value and error go to
    """

    packed: bytes
    log: Path
    answer: Path


@dataclass(frozen=True)
class Plan:
    """All that the process is told.

    :param path: where modules are found
    :param modules: to be imported before any task begins
    :param jobs: in their order
    :param workers: how many at a time
    """

    path: Sequence[str]
    modules: Sequence[str]
    jobs: Sequence[Job]
    workers: int
