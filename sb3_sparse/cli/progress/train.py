"""Bars of a training and of episodes that are played."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import TaskID, TimeElapsedColumn, TimeRemainingColumn

from sb3_sparse.cli.progress import Bar
from sb3_sparse.zoo.match import Match
from sb3_sparse.zoo.watch import TrainingLog

REFRESH_STEPS = 100


class EpisodesProgress(Bar):
    """A bar of the episodes played; without a terminal, a line for each set of episodes.

    The bar goes to where ``sys.stdout`` pointed at first, since it may be silenced meanwhile.

    :param console: where to print
    """

    def __init__(self, console: Console) -> None:
        apart = Console(file=console.file, highlight=False, markup=False)
        kept = dict(transient=True, redirect_stdout=False, redirect_stderr=False)
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
    """The lines of a training, with a bar in place of the tenths if there is a terminal.

    :param console: where to print
    :param headline: printed first, once the run is known to be possible
    """

    def __init__(self, console: Console, headline: str) -> None:
        super().__init__(partial(console.print, soft_wrap=True))
        self.headline = headline
        self.folder: Path | None = None
        self.episodes = EpisodesProgress(console)
        self.steps = Bar(console, "steps, {task.fields[status]}", TimeRemainingColumn())

    def begins(self, folder: Path, match: Match | None) -> None:
        self.folder = folder
        self.say(self.headline)
        super().begins(folder, match)

    def plays(self, what: str, done: int, planned: int) -> None:
        self.episodes(what, done, planned)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.task = self.steps.bar.add_task("", total=self.planned, status=self.status())
        self.steps.bar.start()

    def _on_step(self) -> bool:
        if self.steps.bar.disable:
            return super()._on_step()
        done = min(self.num_timesteps, self.planned)
        if self.n_calls % REFRESH_STEPS == 0 or done == self.planned:
            self.steps.bar.update(self.task, completed=done, status=self.status())
        return True

    def _on_training_end(self) -> None:
        self.steps.bar.update(self.task, completed=self.planned, status=self.status())
        self.close()

    def close(self) -> None:
        """Give the terminal back, also after an interruption."""
        self.steps.close()
        self.episodes.close()
