"""The command line: ``sb3-sparse train`` and ``sb3-sparse inspect``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from sb3_sparse.errors import MissingExtra, SparsityError

try:
    import typer
    from rich.console import Console
except ImportError:
    sys.exit(str(MissingExtra("the command line", "zoo")))

from sb3_sparse.zoo.inspect import inspect_model
from sb3_sparse.zoo.progress import TrainingProgress
from sb3_sparse.zoo.train import Run, reached_sparsity
from sb3_sparse.zoo.train import train as train_run

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Sparse training inside Stable-Baselines3.",
)
console = Console(highlight=False)
EPISODES = 20


@app.command()
def train(
    algo: Annotated[str, typer.Option(help="Algorithm: dqn, sac, ppo, a2c, td3, ...")] = "dqn",
    env: Annotated[str, typer.Option(help="Gymnasium environment id.")] = "CartPole-v1",
    method: Annotated[str, typer.Option(help="dense, static, set, rigl or prune.")] = "rigl",
    sparsity: Annotated[float, typer.Option(help="Removed fraction, in [0, 1).")] = 0.9,
    distribution: Annotated[str, typer.Option(help="erk, er or uniform.")] = "erk",
    n_timesteps: Annotated[
        int | None,
        typer.Option("--n-timesteps", "-n", help="Environment steps.", show_default="as tuned"),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of everything.")] = 0,
    log_folder: Annotated[
        Path, typer.Option("--log-folder", "-f", help="Where the run's folder is made.")
    ] = Path("logs"),
) -> None:
    """Train, evaluate and save a sparse policy. Without arguments: DQN, RigL, 90 %, CartPole-v1."""
    run = Run(algo.lower(), env, method, sparsity, distribution, seed, n_timesteps)
    sparse = "" if method == "dense" else f" at {sparsity:.0%} ({distribution.upper()})"
    console.print(f"Training {algo.upper()} on {env}, {method}{sparse}, seed {seed}")
    progress = TrainingProgress(console)
    try:
        model, results = train_run(run, log_folder, [progress], EPISODES)
    finally:
        progress.close()
    reached = reached_sparsity(model)
    if reached is not None:
        console.print(f"Sparsity {reached:.2%}. Return over {EPISODES} episodes:")
    else:
        console.print(f"Return over {EPISODES} episodes:")
    for result in results:
        score = f"{result.mean_return:.1f} ± {result.std_return:.1f}"
        console.print(
            f"{result.what + ':':<16} [bold]{score}[/bold]  {result.path}", soft_wrap=True
        )
    if reached is not None:
        console.print("The checkpoint was chosen by other episodes. Layer by layer:")
        console.print(f"sb3-sparse inspect {results[-1].path}", soft_wrap=True)


@app.command()
def inspect(
    model: Annotated[Path, typer.Argument(help="A model saved by SB3 (.zip).")],
) -> None:
    """Print shape, nnz, density and FLOPs of every layer of a saved sparse model."""
    console.print(str(inspect_model(model)), soft_wrap=True)


def main() -> None:
    """Run the command line; a user's mistake is one line on stderr and exit code 2."""
    try:
        app(standalone_mode=True)
    except (SparsityError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"Error: {error}", markup=False, soft_wrap=True)
        sys.exit(2)
