"""A process that imports what tasks need once, and then forks a process for each task."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from multiprocessing import Pipe, get_context
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Any

from sb3_sparse.launch.child import Plan, run_job

new_process: Callable[..., BaseProcess] = get_context("spawn").Process
if sys.platform == "linux":
    new_process = get_context("fork").Process
"""On other systems, a process may fail after a fork."""


def main() -> None:
    """Read a plan from standard input, and print number and exit code of each finished job.

    When the input ends, as it does when the process that started this one disappears, running jobs
    are asked to stop and no other is started.
    """
    plan: Plan = pickle.load(sys.stdin.buffer)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # keeps the output of modules apart from answers
    sys.path.extend(folder for folder in plan.path if folder not in sys.path)
    for module in plan.modules:
        with suppress(Exception):  # the job fails with the same error, and reports it
            import_module(module)
    if "torch" in sys.modules:
        import_module("torch._dynamo")  # otherwise each first optimizer does, which takes a second
    gc.freeze()  # otherwise garbage collection would copy all pages in each job
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)  # jobs receive it themselves
    end = _end_of_input()
    waiting, stopped = deque(enumerate(plan.jobs)), False
    alive: dict[int, tuple[int, BaseProcess]] = {}
    while alive or (waiting and not stopped):
        while waiting and not stopped and len(alive) < plan.workers:
            number, job = waiting.popleft()
            process = new_process(target=run_job, args=(job, interrupt))
            process.start()
            alive[process.sentinel] = number, process
        for ready in wait([*alive, *([] if stopped else [end])]):
            if ready in alive:
                number, process = alive.pop(ready)
                process.join()
                print(number, process.exitcode, file=answers, flush=True)
            else:
                stopped = True
                for _, process in alive.values():
                    process.terminate()


def _end_of_input() -> Any:
    """Return what becomes ready for :func:`wait` when the input ends."""
    if sys.platform != "win32":
        return sys.stdin.fileno()
    reader, writer = Pipe(duplex=False)

    def read() -> None:
        sys.stdin.buffer.read()
        writer.close()

    Thread(target=read, daemon=True).start()
    return reader


if __name__ == "__main__":
    main()
