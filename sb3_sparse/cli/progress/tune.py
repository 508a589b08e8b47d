"""The progress of a search, as a user sees it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import TimeElapsedColumn

from sb3_sparse.cli.progress import Bar

if TYPE_CHECKING:
    from sb3_sparse.tuning.backend import FrozenTrial
    from sb3_sparse.tuning.search import SearchStatus


def values_in_words(values: Mapping[str, Any]) -> str:
    """Return a trial's values in a line."""
    return ", ".join(f"{name} {_short(value)}" for name, value in values.items())


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


class TuningProgress(Bar):
    """Print a line for each trial that ends, above a bar with the best so far.

    :param console: where to print; if it is not a terminal, it gets the lines only
    """

    def __init__(self, console: Console) -> None:
        super().__init__(console, "trials, {task.fields[status]}", TimeElapsedColumn())
        self.seen: set[int] | None = None
        self.task = self.bar.add_task("", total=None, status="starting")

    def __call__(self, status: SearchStatus) -> None:
        """Show the search's progress."""
        if self.seen is None:
            self.seen = {trial.number for trial in status.done}
            self.bar.start()
        for trial in (*status.done, *status.failed):
            if trial.number not in self.seen:
                self.seen.add(trial.number)
                self.console.print(self._line(trial, status), soft_wrap=True)
        best = status.best
        best_text = "best –" if best is None else f"best {best.values[0]:.6g} (trial {best.number})"
        running = f"{len(status.running)} running, {best_text}"
        self.bar.update(self.task, completed=len(status.done), total=status.planned, status=running)

    @staticmethod
    def _line(trial: FrozenTrial, status: SearchStatus) -> str:
        if trial in status.failed:
            return f"trial {trial.number} failed: {status.why_failed(trial)}"
        best = status.best
        how = "pruned at" if trial not in status.complete else "score"
        value = f"{trial.values[0]:.6g}" if trial.values else "–"
        so_far = "" if best is None else f", best so far {best.values[0]:.6g} (trial {best.number})"
        count = f"{len(status.done)} of {status.planned}"
        values = values_in_words(status.values_of(trial))
        return f"{count}: trial {trial.number} {how} {value}{so_far}; {values}"
