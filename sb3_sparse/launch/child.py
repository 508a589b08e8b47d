"""A task's process: does the task, writes what came out to a file."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import traceback
from multiprocessing import parent_process
from multiprocessing.connection import wait
from types import FrameType
from typing import Any

import numpy as np

from sb3_sparse.files import written_whole
from sb3_sparse.launch.base import Task
from sb3_sparse.launch.jobs import Job


def do(job: Job, interrupt: Any) -> None:
    """Do the task; stop as by SIGTERM when the process that started this one is gone.

    :param interrupt: what SIGINT does where the tasks come from; nothing, it may be, as in the
        background
    """
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN if interrupt == signal.SIG_IGN else _stop)
    threading.Thread(target=_stop_with_the_parent, daemon=True).start()
    with job.log.open("ab") as log:
        for descriptor in (1, 2):
            os.dup2(log.fileno(), descriptor)
    np.random.seed()  # forks would all draw the same
    value, error = None, None
    try:
        value = Task.unpacked(job.packed)()
    except (Exception, KeyboardInterrupt):
        error = traceback.format_exc()
        print(error, file=sys.stderr)
    with written_whole(job.answer) as new:
        new.write_bytes(pickle.dumps((value, error)))


def _stop(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, as Ctrl-C does; by SIGTERM not while one is being dealt with.

    SIGTERM follows Ctrl-C, and has its use: an exception may get lost, as in a destructor.
    """
    if number == signal.SIGTERM and isinstance(sys.exc_info()[1], KeyboardInterrupt):
        return
    raise KeyboardInterrupt


def _stop_with_the_parent() -> None:
    if sys.platform != "win32":  # or they may come here, and not wake a main thread that waits
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    parent = parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
