"""Progress of commands: bars on a terminal, lines elsewhere."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn


class Bar:
    """A bar that counts.

    :param console: where to print; without a terminal there is no bar
    :param unit: what is counted, e.g. ``"runs, {task.fields[status]}"``
    :param more: further columns
    :param kind: Rich's ``Progress``, or a subclass of it
    :param options: further options of Rich's ``Progress``
    """

    def __init__(
        self,
        console: Console,
        unit: str,
        *more: ProgressColumn,
        kind: type[Progress] = Progress,
        **options: Any,
    ) -> None:
        self.console = console
        self.bar = kind(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TextColumn(unit, markup=False),
            *more,
            console=console,
            disable=not console.is_terminal,
            **options,
        )

    def close(self) -> None:
        """Give the terminal back, also after an interruption."""
        self.bar.stop()
