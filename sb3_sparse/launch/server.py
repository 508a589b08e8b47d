"""A process that imports what tasks need, once, and then forks a process for each of them."""

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

from sb3_sparse.launch.child import do
from sb3_sparse.launch.jobs import Plan

new_process: Callable[..., BaseProcess] = get_context("spawn").Process
if sys.platform == "linux":
    new_process = get_context("fork").Process
"""Elsewhere a process cannot be relied on after a fork without a new program."""


def main() -> None:
    """Read a plan from standard input, and print number and exit code of each job that is over.

    When the input ends, which it does when the process that started this one is gone, the jobs that
    run are asked to stop and no other is begun.
    """
    plan: Plan = pickle.load(sys.stdin.buffer)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what modules print is no answer
    sys.path.extend(folder for folder in plan.path if folder not in sys.path)
    for module in plan.modules:
        with suppress(Exception):  # the job will fail by it, and say so
            import_module(module)
    if "torch" in sys.modules:
        import_module("torch._dynamo")  # as its first optimizer does, which takes a second
    gc.freeze()  # or each job's collections would copy all pages
    interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)  # of which jobs hear by themselves
    end = _end_of_input()
    waiting, stopped = deque(enumerate(plan.jobs)), False
    alive: dict[int, tuple[int, BaseProcess]] = {}
    while alive or (waiting and not stopped):
        while waiting and not stopped and len(alive) < plan.workers:
            number, job = waiting.popleft()
            process = new_process(target=do, args=(job, interrupt))
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
    """What :func:`wait` takes, and finds ready when the input ends."""
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
