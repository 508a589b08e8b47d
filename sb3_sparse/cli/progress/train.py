"""Bars of a training and of episodes that are played."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from sb3_sparse.zoo.match import Match
from sb3_sparse.zoo.watch import TrainingLog

REFRESH_STEPS = 100


class EpisodesProgress:
    """A bar of the episodes played; without a terminal, a line for each set of episodes.

    The bar goes to where ``sys.stdout`` pointed at first, since it may be silenced meanwhile.

    :param console: where to print
    """

    def __init__(self, console: Console) -> None:
        self.progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TextColumn("episodes"),
            TimeElapsedColumn(),
            console=Console(file=console.file, highlight=False, markup=False),
            disable=not console.is_terminal,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
        )
        self.tasks: dict[str, TaskID] = {}

    def __call__(self, what: str, done: int, planned: int) -> None:
        """Show the progress.

        :param what: who plays, e.g. ``"Last policy"``
        """
        if what not in self.tasks:
            self.tasks[what] = self.progress.add_task(what, total=planned)
            if self.progress.disable:
                self.progress.console.print(f"{what}, episodes: {planned}")
            self.progress.start()
        self.progress.update(self.tasks[what], completed=done)

    def close(self) -> None:
        """Give the terminal back, also after an interruption."""
        self.progress.stop()


class TrainingProgress(TrainingLog):
    """The lines of a training, with a bar in place of the tenths if there is a terminal.

    :param console: where to print
    :param headline: printed first, once the run is known to be possible
    """

    def __init__(self, console: Console, headline: str) -> None:
        super().__init__(partial(console.print, soft_wrap=True))
        self.headline = headline
        self.folder: Path | None = None
        self.episodes = EpisodesProgress(console)
        self.progress = Progress(
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TextColumn("steps, {task.fields[status]}", markup=False),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )

    def begins(self, folder: Path, match: Match | None) -> None:
        self.folder = folder
        self.say(self.headline)
        super().begins(folder, match)

    def plays(self, what: str, done: int, planned: int) -> None:
        self.episodes(what, done, planned)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.task = self.progress.add_task("", total=self.planned, status=self.status())
        self.progress.start()

    def _on_step(self) -> bool:
        if self.progress.disable:
            return super()._on_step()
        done = min(self.num_timesteps, self.planned)
        if self.n_calls % REFRESH_STEPS == 0 or done == self.planned:
            self.progress.update(self.task, completed=done, status=self.status())
        return True

    def _on_training_end(self) -> None:
        self.progress.update(self.task, completed=self.planned, status=self.status())
        self.close()

    def close(self) -> None:
        """Give the terminal back, also after an interruption."""
        self.progress.stop()
        self.episodes.close()
