"""Tasks as processes of this machine."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from threading import Event, Lock

from sb3_sparse.errors import ConfigError
from sb3_sparse.launch.base import EVERY, Ended, Launcher, Task, check_workers

SHOWN_LINES = 15


class LocalLauncher(Launcher):
    """Each task in a new Python process with one thread; a thread of ours waits for each.

    :param address: must be None
    """

    def __init__(self, address: str | None = None) -> None:
        if address is not None:
            raise ConfigError(
                f"an address ({address!r}) is Ray's; add --launcher ray, or leave it out"
            )

    def run(self, tasks: Sequence[Task], workers: int) -> Generator[Ended | None, None, None]:
        """See :meth:`Launcher.run`."""
        check_workers(workers)
        processes = _Processes()
        with ThreadPoolExecutor(workers) as pool:
            left = {pool.submit(processes.run, task) for task in tasks}
            try:
                while left:
                    done, left = wait(left, timeout=EVERY, return_when=FIRST_COMPLETED)
                    for future in done:
                        yield future.result()
                    if not done:
                        yield None
            finally:
                processes.stop()
                pool.shutdown(cancel_futures=True)


class _Processes:
    """The processes that are alive, so that all can be stopped."""

    def __init__(self) -> None:
        self.alive: set[subprocess.Popen[bytes]] = set()
        self.lock = Lock()
        self.stopped = Event()

    def run(self, task: Task) -> Ended:
        with tempfile.TemporaryDirectory() as folder:
            answer, log = Path(folder) / "answer", task.log or Path(folder) / "log"
            log.parent.mkdir(parents=True, exist_ok=True)
            with log.open("ab") as output:
                with self.lock:
                    if self.stopped.is_set():
                        return Ended(task, error="not started")
                    process = subprocess.Popen(
                        [sys.executable, "-m", "sb3_sparse.launch.child", str(answer)],
                        stdin=subprocess.PIPE,
                        stdout=output,
                        stderr=subprocess.STDOUT,
                        env={**os.environ, "OMP_NUM_THREADS": "1"},
                    )
                    self.alive.add(process)
                try:
                    return self._talk(process, task, answer, log)
                finally:
                    with self.lock:
                        self.alive.discard(process)

    def _talk(self, process: subprocess.Popen[bytes], task: Task, answer: Path, log: Path) -> Ended:
        assert process.stdin is not None
        try:
            process.stdin.write(pickle.dumps(task.packed()))
            process.stdin.write(b"\n")
            process.stdin.flush()  # and stays open: its end tells the child that we are gone
        except BrokenPipeError:
            pass  # the exit code says more
        code = process.wait()
        process.stdin.close()
        if answer.is_file():
            value, error = pickle.loads(answer.read_bytes())
            return Ended(task, value, error)
        lines = log.read_text(errors="replace").splitlines()[-SHOWN_LINES:]
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"exited with {code}"
        return Ended(task, error="\n".join([f"its process {how}", *(lines if code > 0 else [])]))

    def stop(self) -> None:
        with self.lock:
            self.stopped.set()
            for process in self.alive:
                process.terminate()
