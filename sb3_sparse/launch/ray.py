"""Runs tasks on a Ray cluster."""

from __future__ import annotations

import os
import socket
import traceback
from collections.abc import Generator, Sequence
from typing import Any

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.launch.base import POLL_SECONDS, Launcher, Task, TaskResult, check_workers

PATIENCE = 10.0  # seconds for a cluster to answer
GRACE = 60.0  # seconds for a task to stop when it is asked to


class RayLauncher(Launcher):
    """Runs each task as a Ray task that requests one CPU, on whichever machine Ray chooses.

    Every machine of the cluster needs the same version of this package and must see the same
    folders and storage. If this process is connected to a cluster already, that one is used.

    :param address: address of the cluster, e.g. ``"auto"`` or ``"ray://head:10001"``; None: a
        cluster of this machine alone, for as long as the tasks run
    :raises MissingExtra: if Ray is not installed
    """

    def __init__(self, address: str | None = None) -> None:
        try:
            import ray
        except ImportError as error:
            raise MissingExtra("the launcher 'ray'", "ray") from error
        self.ray = ray
        self.address = address

    def run(self, tasks: Sequence[Task], workers: int) -> Generator[TaskResult | None, None, None]:
        """See :meth:`Launcher.run`."""
        check_workers(workers)
        ray, ours = self.ray, not self.ray.is_initialized()
        if ours:
            self._connect(workers)
        call = ray.remote(num_cpus=1, max_calls=1, max_retries=0)(_in_one_thread)
        waiting = list(reversed(tasks))
        running: dict[Any, Task] = {}
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    task = waiting.pop()
                    running[call.remote(task.packed())] = task
                done, _ = ray.wait(list(running), timeout=POLL_SECONDS)
                for reference in done:
                    yield self._ended(reference, running.pop(reference))
                if not done:
                    yield None
        finally:
            for reference in running:
                ray.cancel(reference)  # KeyboardInterrupt in the task
            if running:
                _, deaf = ray.wait(list(running), num_returns=len(running), timeout=GRACE)
                for reference in deaf:
                    ray.cancel(reference, force=True)
            if ours:
                ray.shutdown()

    def _connect(self, workers: int) -> None:
        here: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False}
        try:
            if self.address is not None and ":" in self.address:
                _reach(self.address)  # Ray itself tries for minutes
            self.ray.init(
                address=self.address or "local",
                log_to_driver=False,
                **(here if self.address is None else {}),
            )
        except (OSError, ValueError, RuntimeError) as error:
            raise ConfigError(
                f"there is no Ray cluster at {self.address!r} ({error}); start one with `ray start "
                "--head`, or leave the address out"
            ) from error

    def _ended(self, reference: Any, task: Task) -> TaskResult:
        try:
            value, error = self.ray.get(reference)
        except self.ray.exceptions.RayError as failure:
            return TaskResult(task, error=f"Ray reports: {failure}")
        return TaskResult(task, value, error)


def _reach(address: str) -> None:
    """Connect once to ``host:port`` or ``ray://host:port``."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    socket.create_connection((host, int(port)), timeout=PATIENCE).close()


def _in_one_thread(task: bytes) -> tuple[Any, str | None]:
    os.environ["OMP_NUM_THREADS"] = "1"  # before the task imports torch
    try:
        return Task.unpacked(task)(), None
    except (Exception, KeyboardInterrupt):
        return None, traceback.format_exc()
