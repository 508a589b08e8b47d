"""Runs tasks as processes of this machine."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import IO

from sb3_sparse.errors import ConfigError
from sb3_sparse.launch.base import POLL_SECONDS, Launcher, Task, TaskResult, check_workers
from sb3_sparse.launch.child import Job, Plan

SHOWN_LINES = 15


class LocalLauncher(Launcher):
    """Runs each task in its own process with one thread.

    One process imports the modules of all tasks and forks for each task, so that tasks start at
    once. The modules must not start threads when they are imported.

    :param address: must be None
    """

    def __init__(self, address: str | None = None) -> None:
        if address is not None:
            raise ConfigError(
                f"an address ({address!r}) is Ray's; add --launcher ray, or leave it out"
            )

    def run(self, tasks: Sequence[Task], workers: int) -> Generator[TaskResult | None, None, None]:
        """See :meth:`Launcher.run`."""
        check_workers(workers)
        with tempfile.TemporaryDirectory() as name:
            jobs = [_job(Path(name) / str(number), task) for number, task in enumerate(tasks)]
            modules = dict.fromkeys(task.function.partition(":")[0] for task in tasks)
            output = Path(name) / "server"
            with _Server(Plan(sys.path, list(modules), jobs, workers), output) as server:
                waiting = dict(enumerate(tasks))
                while waiting:
                    try:
                        answer = server.answers.get(timeout=POLL_SECONDS)
                    except Empty:
                        yield None
                        continue
                    if answer is None:
                        break
                    number, code = map(int, answer.split())
                    yield _ended(waiting.pop(number), jobs[number], code)
            for task in waiting.values():  # the server ended early
                yield TaskResult(task, error=_error(server.process.returncode, output))


class _Server:
    """Keeps the process that forks alive for the duration of a block.

    :param plan: what the process does
    :param output: file for its output, except its answers
    """

    def __init__(self, plan: Plan, output: Path) -> None:
        self.plan = plan
        self.output = output
        self.answers: Queue[str | None] = Queue()

    def __enter__(self) -> _Server:
        with self.output.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sb3_sparse.launch.server"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=output,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.reader = Thread(target=_read, args=(self.process.stdout, self.answers), daemon=True)
        self.reader.start()
        with suppress(BrokenPipeError):  # the exit code explains more
            self.process.stdin.write(pickle.dumps(self.plan))
            self.process.stdin.flush()  # stays open: closing it stops all tasks
        return self

    def __exit__(self, *_: object) -> None:
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):
            self.process.stdin.close()
        self.process.wait()
        self.reader.join()


def _read(lines: IO[bytes], into: Queue[str | None]) -> None:
    with lines:
        for line in lines:
            into.put(line.decode())
    into.put(None)


def _job(files: Path, task: Task) -> Job:
    log = files.with_suffix(".log") if task.log is None else task.log
    log.parent.mkdir(parents=True, exist_ok=True)
    return Job(task.packed(), log.absolute(), files.with_suffix(".answer"))


def _ended(task: Task, job: Job, code: int) -> TaskResult:
    if job.answer.is_file():
        value, error = pickle.loads(job.answer.read_bytes())
        return TaskResult(task, value, error)
    return TaskResult(task, error=_error(code, job.log))


def _error(code: int, log: Path) -> str:
    """Describe why a process ended before its task did."""
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with {code}"
    lines = log.read_text(errors="replace").splitlines()[-SHOWN_LINES:]
    return "\n".join([f"its process {how}", *(lines if code > 0 else [])])
