"""The command line, ``sb3-sparse``: each file defines one or two commands."""

from __future__ import annotations

import sys
import warnings
from importlib.metadata import version
from typing import Annotated, Any

from sb3_sparse.errors import MissingExtra, SparsityError, SparsityWarning

try:
    import typer
    from rich.console import Console

    from sb3_sparse.cli.card import card_command
    from sb3_sparse.cli.common import say
    from sb3_sparse.cli.compress import compress_command
    from sb3_sparse.cli.export import ExportCommand, export_command
    from sb3_sparse.cli.look import enjoy_command, inspect_command
    from sb3_sparse.cli.study import studies
    from sb3_sparse.cli.train import train_command
    from sb3_sparse.cli.tune import tuning
except ImportError as error:
    sys.exit(str(error if isinstance(error, MissingExtra) else MissingExtra("this command", "zoo")))

MORE_VALUES = {"allow_extra_args": True}

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _show_version(asked: bool) -> None:
    if asked:
        say(f"sb3-sparse {version('sb3-sparse')}")
        raise typer.Exit


@app.callback()
def _general(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """Sparse training inside Stable-Baselines3."""


app.command("train", context_settings=MORE_VALUES)(train_command)
app.command("enjoy")(enjoy_command)
app.command("inspect")(inspect_command)
app.command("card")(card_command)
app.command("compress")(compress_command)
app.command("export", cls=ExportCommand)(export_command)
app.add_typer(tuning, name="tune", help="Search hyperparameters with Optuna, and report.")
app.add_typer(studies, name="study", help="Run and report whole comparisons, as the paper's.")


def _show_ours_alone() -> None:
    """Show warnings of this package without the line of code that raised them.

    ``warnings.catch_warnings`` undoes it.
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
    """Run the command line; report a user's mistake as one line on stderr, with exit code 2."""
    try:
        with warnings.catch_warnings():
            _show_ours_alone()
            app(standalone_mode=True)
    except (SparsityError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"Error: {error}", markup=False, soft_wrap=True)
        sys.exit(2)
