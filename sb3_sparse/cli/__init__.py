"""The command line, ``sb3-sparse``: one file a command or two."""

from __future__ import annotations

import sys
import warnings
from typing import Any

from sb3_sparse.errors import MissingExtra, SparsityError, SparsityWarning

try:
    import typer
    from rich.console import Console

    from sb3_sparse.cli.compress import compress
    from sb3_sparse.cli.export import export
    from sb3_sparse.cli.look import enjoy, inspect
    from sb3_sparse.cli.study import studies
    from sb3_sparse.cli.train import train
    from sb3_sparse.cli.tune import tuning
except ImportError as error:
    sys.exit(str(error if isinstance(error, MissingExtra) else MissingExtra("this command", "zoo")))

MORE_VALUES = {"allow_extra_args": True}

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Sparse training inside Stable-Baselines3.",
)
app.command(context_settings=MORE_VALUES)(train)
app.command()(enjoy)
app.command()(inspect)
app.command()(compress)
app.command()(export)
app.add_typer(tuning, name="tune", help="Search hyperparameters with Optuna, and report.")
app.add_typer(studies, name="study", help="Run and report whole comparisons, as the paper's.")


def _show_ours_alone() -> None:
    """Show our own warnings without the line of code that they come from, which says nothing here.

    The change ends with ``warnings.catch_warnings``.
    """
    show = warnings.showwarning

    def shown(message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, SparsityWarning):
            return show(message, category, *where, **more)
        Console(stderr=True, highlight=False).print(
            f"Warning: {message}", markup=False, soft_wrap=True
        )

    warnings.showwarning = shown


def main() -> None:
    """Run the command line; a user's mistake is one line on stderr and exit code 2."""
    try:
        with warnings.catch_warnings():
            _show_ours_alone()
            app(standalone_mode=True)
    except (SparsityError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"Error: {error}", markup=False, soft_wrap=True)
        sys.exit(2)
