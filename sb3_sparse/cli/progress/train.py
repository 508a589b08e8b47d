"""Bars of a training and of episodes that are played."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import Progress, TaskID, TimeElapsedColumn
from rich.text import Text

from sb3_sparse.cli.progress import Bar
from sb3_sparse.zoo.match import Match
from sb3_sparse.zoo.watch import TrainingLog

REFRESH_STEPS = 100
LEVELS = "▁▂▃▄▅▆▇█"


def sparkline(values: Sequence[float], width: int = 30) -> str:
    """Return the latest values as a row of blocks, from the lowest of them to the highest.

    :param width: how many at most
    """
    shown = values[-width:]
    if not shown:
        return ""
    low, high = min(shown), max(shown)
    top = len(LEVELS) - 1
    return "".join(
        LEVELS[round(top * (value - low) / (high - low)) if high > low else top] for value in shown
    )


class WithLine(Progress):
    """A bar with a line of text below it: the field ``line`` of its tasks."""

    def get_renderables(self) -> Iterable[RenderableType]:
        """Return the bar and the lines."""
        yield from super().get_renderables()
        for task in self.tasks:
            yield Text(task.fields["line"], no_wrap=True, overflow="ellipsis")


class EpisodesProgress(Bar):
    """A bar of the episodes played; without a terminal, a line for each set of episodes.

    The bar goes to where ``sys.stdout`` pointed at first, since it may be silenced meanwhile.

    :param console: where to print
    """

    def __init__(self, console: Console) -> None:
        apart = Console(file=console.file, highlight=False, markup=False)
        kept: dict[str, Any] = dict(transient=True, redirect_stdout=False, redirect_stderr=False)
        super().__init__(apart, "episodes", TimeElapsedColumn(), **kept)
        self.tasks: dict[str, TaskID] = {}

    def __call__(self, what: str, done: int, planned: int) -> None:
        """Show the progress.

        :param what: who plays, e.g. ``"Last policy"``
        """
        if what not in self.tasks:
            self.tasks[what] = self.bar.add_task(what, total=planned)
            if self.bar.disable:
                self.console.print(f"{what}, episodes: {planned}")
            self.bar.start()
        self.bar.update(self.tasks[what], completed=done)


class TrainingProgress(TrainingLog):
    """The lines of a training; on a terminal, a live view in place of those of the tenths.

    It shows a bar of the steps with the time left, and below it the return, the sparsity, the steps
    a second, and the returns of all evaluations so far as a row of blocks.

    :param console: where to print
    :param headline: printed first, once the run is known to be possible
    """

    def __init__(self, console: Console, headline: str) -> None:
        super().__init__(partial(console.print, soft_wrap=True))
        self.headline = headline
        self.folder: Path | None = None
        self.episodes = EpisodesProgress(console)
        self.returns: list[float] = []
        self.steps = Bar(console, "steps, time left {task.fields[left]}", kind=WithLine)

    def begins(self, folder: Path, match: Match | None) -> None:
        self.folder = folder
        self.say(self.headline)
        super().begins(folder, match)

    def evaluated(self, step: int, mean: float, std: float, best: float | None) -> None:
        super().evaluated(step, mean, std, best)
        self.returns.append(mean)

    def plays(self, what: str, done: int, planned: int) -> None:
        self.episodes(what, done, planned)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.task = self.steps.bar.add_task("", total=self.planned, **self.fields())
        self.steps.bar.start()

    def stepped(self, done: int) -> None:
        if self.steps.bar.disable:
            super().stepped(done)
        elif self.n_calls % REFRESH_STEPS == 0 or done == self.planned:
            self.steps.bar.update(self.task, completed=done, **self.fields())

    def _on_training_end(self) -> None:
        self.steps.bar.update(self.task, completed=self.planned, **self.fields())
        self.close()

    def fields(self) -> dict[str, Any]:
        """Return the texts of the bar."""
        left = self.seconds_left()
        time_left = "–" if left is None else str(timedelta(seconds=round(left)))
        return {"left": time_left, "line": self.line()}

    def line(self) -> str:
        """Return the line below the bar."""
        plain = not self.returns or self.steps.console.options.ascii_only
        return self.status() + ("" if plain else f"  {sparkline(self.returns)}")

    def close(self) -> None:
        """Give the terminal back, also after an interruption."""
        self.steps.close()
        self.episodes.close()
