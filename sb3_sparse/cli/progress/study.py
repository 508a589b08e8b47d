"""The bar of a study."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bars

if TYPE_CHECKING:
    from sb3_sparse.studies import Progress


class StudyProgress:
    """Prints a line for each finished run, above a bar with counts and the time left.

    :param console: where to print; without a terminal there is no bar
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self.retried = 0
        self.bar: Bars | None = None

    def __call__(self, progress: Progress) -> None:
        """Show the progress."""
        if self.bar is None:
            self.bar = Bars(
                BarColumn(bar_width=30),
                MofNCompleteColumn(),
                TextColumn("runs, {task.fields[status]}", markup=False),
                console=self.console,
                disable=not self.console.is_terminal,
            )
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

    def close(self) -> None:
        """Give the terminal back, also after an interruption."""
        if self.bar is not None:
            self.bar.stop()


def time_left(progress: Progress) -> str:
    """Describe the time left."""
    seconds = progress.seconds_left
    if seconds is None:
        return "time left unknown"
    return f"{timedelta(seconds=round(seconds))} left"
