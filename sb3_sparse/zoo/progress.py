"""What a user sees while a run goes on."""

from __future__ import annotations

from statistics import fmean

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.mixin import SparsePolicyMixin

REFRESH_STEPS = 100


class TrainingProgress(BaseCallback):
    """A bar with the mean return of the last episodes and the sparsity.

    On something that is no terminal, a line every tenth of the run instead.

    :param console: where to print
    """

    def __init__(self, console: Console) -> None:
        super().__init__()
        self.console = console
        self.progress = Progress(
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TextColumn("steps, {task.fields[status]}", markup=False),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )

    def _on_training_start(self) -> None:
        self.planned = self.model._total_timesteps
        self.printed = 0
        policy = self.model.policy
        if isinstance(policy, SparsePolicyMixin):
            compact = [layer.compact for layer in policy.sparse.layers]
            if any(compact):
                self.console.print(f"{sum(compact)} of {len(compact)} layers compute on non-zeros")
        self.task = self.progress.add_task("", total=self.planned, status=self._status())
        self.progress.start()

    def _status(self) -> str:
        returns = [float(episode["r"]) for episode in self.model.ep_info_buffer or ()]
        text = f"return {fmean(returns):.1f}" if returns else "return –"
        policy = unwrapped(self.model.policy)
        if isinstance(policy, SparsePolicyMixin):
            text += f", sparsity {policy.sparse.sparsity:.2%}"
        return text

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
