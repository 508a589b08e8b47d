"""The bar of a study."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING

from rich.console import Console

from sb3_sparse.cli.progress import Bar

if TYPE_CHECKING:
    from sb3_sparse.studies import Progress


class StudyProgress(Bar):
    """Prints a line for each finished run, above a bar with counts and the time left.

    :param console: where to print; without a terminal there is no bar
    """

    def __init__(self, console: Console) -> None:
        super().__init__(console, "runs, {task.fields[status]}")
        self.retried = 0

    def __call__(self, progress: Progress) -> None:
        """Show the progress."""
        if not self.bar.task_ids:
            self.task = self.bar.add_task("", total=progress.planned, status="starting")
            self.console.print(f"{progress.done} of {progress.planned} runs are already done")
            self.bar.start()
        for name in progress.retried[self.retried :]:
            self.console.print(f"failed, will be tried again at the end: {name}")
        self.retried = len(progress.retried)
        if progress.ended is not None:
            done = f"{progress.done} of {progress.planned}"
            line = f"{done}: {progress.ended}; {time_left(progress)}"
            self.console.print(line, soft_wrap=True)
        status = (
            f"{progress.running} running, {progress.diverged} diverged, "
            f"{len(progress.failed)} failed, {time_left(progress)}"
        )
        self.bar.update(self.task, completed=progress.done, status=status)


def time_left(progress: Progress) -> str:
    """Describe the time left."""
    seconds = progress.seconds_left
    if seconds is None:
        return "time left unknown"
    return f"{timedelta(seconds=round(seconds))} left"
