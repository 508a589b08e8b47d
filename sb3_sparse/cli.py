"""The command line: ``sb3-sparse train``, ``enjoy`` and ``inspect``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

from sb3_sparse.errors import ConfigError, MissingExtra, SparsityError

try:
    import typer
    from rich.console import Console

    from sb3_sparse.zoo.run import Run
except ImportError as error:
    sys.exit(str(error if isinstance(error, MissingExtra) else MissingExtra("this command", "zoo")))

from sb3_sparse.zoo.inspect import inspect_model
from sb3_sparse.zoo.progress import TrainingProgress
from sb3_sparse.zoo.settings import method_of, parse_overrides

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Sparse training inside Stable-Baselines3.",
)
console = Console(highlight=False)
INTERRUPTED = 130
AS_CONFIG = "as the config"


def text(help: str, *names: str, shown: str | bool = True) -> Any:
    """An option."""
    return typer.Option(*names, help=help, show_default=shown)


@app.command(context_settings={"allow_extra_args": True})
def train(
    context: typer.Context,
    algo: Annotated[str, text("Algorithm: dqn, sac, ppo, td3, tqc, ...")] = "dqn",
    env: Annotated[str, text("Gymnasium environment id.")] = "CartPole-v1",
    method: Annotated[str | None, text("dense, prune, static, set or rigl.", shown="rigl")] = None,
    sparsity: Annotated[float | None, text("Removed fraction, in [0, 1).", shown=AS_CONFIG)] = None,
    distribution: Annotated[str | None, text("erk, er or uniform.", shown="erk")] = None,
    match_params: Annotated[
        float | None,
        text(
            "With --method dense: a dense network with as few parameters as this sparsity leaves."
        ),
    ] = None,
    seed: Annotated[int, text("Seed of everything.")] = 0,
    n_timesteps: Annotated[
        int | None, text("Environment steps.", "--n-timesteps", "-n", shown=AS_CONFIG)
    ] = None,
    n_envs: Annotated[int | None, text("Environments side by side.", shown=AS_CONFIG)] = None,
    hyperparams: Annotated[
        list[str] | None,
        text(
            "Anything else, as name:value ..., e.g. learning_rate:0.001 weight_decay:1e-4 "
            "update_interval:500.",
            "--hyperparams",
            "-params",
        ),
    ] = None,
    conf_file: Annotated[
        str | None,
        text(
            "A YAML file in rl-zoo's form, or another shipped one by name (dqn_impala).",
            "--conf-file",
            "-conf",
        ),
    ] = None,
    eval_freq: Annotated[
        int | None, text("Steps between two evaluations.", shown="as the paper")
    ] = None,
    eval_episodes: Annotated[
        int | None, text("Episodes of an evaluation.", shown="as the paper")
    ] = None,
    device: Annotated[str, text("auto, cpu or cuda.")] = "auto",
    tensorboard_log: Annotated[
        str, text("Folder of TensorBoard's files.", "--tensorboard-log", "-tb")
    ] = "",
    log_folder: Annotated[
        Path, text("Where the run's folder is made.", "--log-folder", "-f")
    ] = Path("logs"),
    resume: Annotated[
        Path | None, text("Go on with an interrupted run: its folder. Takes no other option.")
    ] = None,
) -> None:
    """Train, evaluate and save a sparse policy. Without arguments: DQN, RigL, 90 %, CartPole-v1."""
    from sb3_sparse.zoo import train as engine  # rl_zoo3 takes its time to import

    progress = TrainingProgress(console)
    try:
        if resume is not None:
            _refuse_other_options(context)
            console.print(f"Going on with {resume}", soft_wrap=True)
            outcome = engine.resume(resume, [progress])
        else:
            if context.args and not hyperparams:
                raise ConfigError(f"unexpected argument {context.args[0]!r}; see --help")
            run = Run(
                algo=algo.lower(),
                env_id=env,
                method=method,
                sparsity=sparsity,
                distribution=distribution,
                match_params=match_params,
                seed=seed,
                n_timesteps=n_timesteps,
                n_envs=n_envs,
                hyperparams=parse_overrides([*(hyperparams or []), *context.args]),
                conf_file=conf_file,
                eval_freq=eval_freq,
                eval_episodes=eval_episodes,
                device=device,
            )
            console.print(_headline(run))
            outcome = engine.train(run, log_folder, [progress], tensorboard_log)
    except KeyboardInterrupt:
        console.print(
            "Interrupted. A run that had begun goes on with sb3-sparse train --resume ITS_FOLDER"
        )
        raise typer.Exit(INTERRUPTED) from None
    finally:
        progress.close()
    if not outcome.finished:
        steps = outcome.model.num_timesteps
        console.print(f"Stopped after {steps} steps. Go on with:", soft_wrap=True)
        console.print(f"sb3-sparse train --resume {outcome.folder}", soft_wrap=True)
        raise typer.Exit(INTERRUPTED)
    results = outcome.results
    reached = engine.reached_sparsity(outcome.model)
    console.print(f"Sparsity {reached:.2%}. Return over {results[0].episodes} episodes:")
    for result in results:
        _print_score(f"{result.what}:", result.mean_return, result.std_return, result.path)
    best = " --best" if len(results) > 1 else ""
    console.print(
        "The best policy was chosen by other episodes. Look at it:" if best else "Look at it:"
    )
    for command in (f"enjoy {outcome.folder}{best}", f"inspect {results[-1].path}"):
        console.print(f"sb3-sparse {command}", soft_wrap=True)


def _headline(run: Run) -> str:
    settings = run.settings()
    kwargs, method = settings["policy_kwargs"], method_of(settings)
    if run.match_params is not None:
        how = f"dense with the parameters of {run.match_params:.0%}"
    elif method == "dense":
        how = method
    else:
        sparsity = kwargs["sparsity"]
        share = f"{sparsity:.0%}" if isinstance(sparsity, float) else str(sparsity)
        how = f"{method} at {share} ({kwargs.get('distribution', 'erk').upper()})"
    return f"Training {run.algo.upper()} on {run.env_id}, {how}, seed {run.seed}"


def _refuse_other_options(context: typer.Context) -> None:
    """A resumed run is the run that it was."""
    given = [
        name
        for name in context.params
        if (source := context.get_parameter_source(name)) is not None
        and source.name == "COMMANDLINE"
    ]
    others = [f"--{name.replace('_', '-')}" for name in given if name != "resume"]
    if others or context.args:
        raise ConfigError(
            f"--resume takes everything from the run; drop {' '.join([*others, *context.args])}"
        )


def _print_score(what: str, mean: float, std: float, path: Path) -> None:
    score = f"{mean:.1f} ± {std:.1f}"
    console.print(f"{what:<13} [bold]{score}[/bold]  {path}", soft_wrap=True)


@app.command()
def enjoy(
    run: Annotated[Path, typer.Argument(help="A run's folder, e.g. logs/dqn/CartPole-v1_1.")],
    episodes: Annotated[int, text("How many episodes.", "--episodes", "-n")] = 20,
    best: Annotated[bool, text("The best policy instead of the last.", "--best")] = False,
    video: Annotated[bool, text("Record a video of the first 1000 steps.", "--video")] = False,
    seed: Annotated[int, text("Seed of the environment.")] = 0,
) -> None:
    """Evaluate what a run has trained, and record a video of it."""
    from sb3_sparse.zoo.enjoy import enjoy as score_run

    score = score_run(run, episodes, best, video, seed)
    console.print(f"Return over {score.episodes} episodes:")
    _print_score(
        "Best policy:" if best else "Last policy:", score.mean_return, score.std_return, score.model
    )
    for path in score.videos:
        console.print(f"Video: {path}", soft_wrap=True)


@app.command()
def inspect(
    model: Annotated[Path, typer.Argument(help="A model saved by SB3 (.zip).")],
) -> None:
    """Print the layers of a saved sparse model, and how they are best computed on this machine."""
    console.print(str(inspect_model(model)), soft_wrap=True)


def main() -> None:
    """Run the command line; a user's mistake is one line on stderr and exit code 2."""
    try:
        app(standalone_mode=True)
    except (SparsityError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"Error: {error}", markup=False, soft_wrap=True)
        sys.exit(2)
