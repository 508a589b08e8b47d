"""What a user sees while a run goes on."""

from __future__ import annotations

import time
from pathlib import Path
from statistics import fmean

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

from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.zoo.computing import gradient_steps_of
from sb3_sparse.zoo.match import Match
from sb3_sparse.zoo.watch import Watch

REFRESH_STEPS = 100


class EpisodesProgress:
    """A bar of the episodes that are played; on something that is no terminal, a line for each set.

    What plays them may silence ``sys.stdout``: the bar goes to where it pointed before.

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
        """Show how far it is.

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


class TrainingProgress(Watch):
    """A line for each evaluation, and a bar with the return of the last episodes, the sparsity and
    what a second of training was good for in environment steps, evaluations included.

    On something that is no terminal, a line every tenth of the run in place of the bar.

    :param console: where to print; None: to standard output
    """

    def __init__(self, console: Console | None = None) -> None:
        super().__init__()
        console = Console(highlight=False, markup=False) if console is None else console
        self.console = console
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
        if match is not None:
            self.console.print(str(match), soft_wrap=True)

    def evaluated(self, step: int, mean: float, std: float, best: float | None) -> None:
        so_far = "no best yet, still too dense" if best is None else f"best so far {best:.1f}"
        self.console.print(
            f"evaluated at step {step}: return {mean:.1f} ± {std:.1f}, {so_far}",
            soft_wrap=True,
        )

    def plays(self, what: str, done: int, planned: int) -> None:
        self.episodes(what, done, planned)

    def _on_training_start(self) -> None:
        self.planned = self.model._total_timesteps
        self.printed = 0
        policy = unwrapped(self.model.policy)
        if isinstance(policy, BaseSparsePolicy):
            sparse = [layer.is_sparse for layer in policy.sparse.layers]
            if any(sparse):
                self.console.print(f"{sum(sparse)} of {len(sparse)} layers in sparse storage")
        self.console.print(f"Gradient steps: {gradient_steps_of(self.model)}", soft_wrap=True)
        self.task = self.progress.add_task("", total=self.planned, status=self._status())
        self.progress.start()

    def _status(self) -> str:
        returns = [float(episode["r"]) for episode in self.model.ep_info_buffer or ()]
        text = f"return {fmean(returns):.1f}" if returns else "return –"
        policy = unwrapped(self.model.policy)
        if isinstance(policy, BaseSparsePolicy):
            text += f", sparsity {policy.sparse.sparsity:.2%}"
        seconds = (time.time_ns() - self.model.start_time) / 1e9  # as SB3's own time/fps
        done = self.model.num_timesteps - self.model._num_timesteps_at_start
        return f"{text}, {done / seconds:.0f} steps a second" if done else text

    def _on_step(self) -> bool:
        done = min(self.num_timesteps, self.planned)
        if self.n_calls % REFRESH_STEPS == 0 or done == self.planned:
            self.progress.update(self.task, completed=done, status=self._status())
        tenth = 10 * done // self.planned
        if not self.console.is_terminal and tenth > self.printed:
            self.printed = tenth
            self.console.print(f"{done} of {self.planned} steps, {self._status()}")
        return True

    def _on_training_end(self) -> None:
        self.progress.update(self.task, completed=self.planned, status=self._status())
        self.close()

    def close(self) -> None:
        """Give the terminal back, also after an interruption."""
        self.progress.stop()
        self.episodes.close()
