"""A task's process: runs the task and writes the result to a file."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import wait
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from sb3_sparse.files import written_whole
from sb3_sparse.launch.base import Task


@dataclass(frozen=True)
class Job:
    """A task and its files.

    :param packed: the task, as :meth:`Task.packed` makes it
    :param log: all output is appended to this file
    :param answer: value and error are written to this file
    """

    packed: bytes
    log: Path
    answer: Path


@dataclass(frozen=True)
class Plan:
    """The jobs of the process that forks.

    :param path: where modules are found
    :param modules: modules to import before the first task begins
    :param jobs: the jobs, in order
    :param workers: number of jobs at a time
    """

    path: Sequence[str]
    modules: Sequence[str]
    jobs: Sequence[Job]
    workers: int


def run_job(job: Job, interrupt: Any) -> None:
    """Run a task; stop as by SIGTERM if the process that started this one disappears.

    :param interrupt: how the launching process handles SIGINT; it may ignore it, as background
        processes do
    """
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN if interrupt == signal.SIG_IGN else _stop)
    threading.Thread(target=_stop_with_the_parent, daemon=True).start()
    with job.log.open("ab") as log:
        for descriptor in (1, 2):
            os.dup2(log.fileno(), descriptor)
    np.random.seed()  # otherwise all forks would draw the same numbers
    value, error = None, None
    try:
        value = Task.unpacked(job.packed)()
    except (Exception, KeyboardInterrupt):
        error = traceback.format_exc()
        print(error, file=sys.stderr)
    with written_whole(job.answer) as new:
        new.write_bytes(pickle.dumps((value, error)))


def _stop(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt as Ctrl-C does, unless SIGTERM arrives while one is being handled.

    SIGTERM always follows Ctrl-C, since the first exception may get lost, e.g. in a destructor.
    """
    if number == signal.SIGTERM and isinstance(sys.exc_info()[1], KeyboardInterrupt):
        return
    raise KeyboardInterrupt


def _stop_with_the_parent() -> None:
    if sys.platform != "win32":  # signals in this thread would not wake a waiting main thread
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
