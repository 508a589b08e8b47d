"""``sb3-sparse train``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sb3_sparse.cli.common import (
    ALGO,
    ENV,
    INTERRUPTED,
    ConfFile,
    Device,
    Distribution,
    Envs,
    EvalEpisodes,
    EvalFreq,
    GymPackages,
    Hyperparams,
    LogFolder,
    Method,
    Sparsity,
    Steps,
    console,
    option,
    run_spec,
    say,
)
from sb3_sparse.cli.outcome import tell
from sb3_sparse.errors import ConfigError, command

if TYPE_CHECKING:
    from sb3_sparse.zoo.results import Outcome
    from sb3_sparse.zoo.spec import RunSpec


def train_command(
    context: typer.Context,
    algo: Annotated[str | None, option(ALGO, shown="one that suits the environment")] = None,
    env: Annotated[str | None, option(ENV, shown="one that suits the algorithm")] = None,
    method: Method = None,
    sparsity: Sparsity = None,
    distribution: Distribution = None,
    match_params: Annotated[
        float | None,
        option(
            "With --method dense: a dense network with as few parameters as this sparsity leaves."
        ),
    ] = None,
    seed: Annotated[int, option("Seed of everything.")] = 0,
    n_timesteps: Steps = None,
    n_envs: Envs = None,
    hyperparams: Hyperparams = None,
    conf_file: ConfFile = None,
    gym_packages: GymPackages = None,
    eval_freq: EvalFreq = None,
    eval_episodes: EvalEpisodes = None,
    device: Device = "auto",
    tensorboard_log: Annotated[
        str, option("Folder of TensorBoard's files.", "--tensorboard-log", "-tb")
    ] = "",
    log_folder: LogFolder = Path("logs"),
    resumed: Annotated[
        Path | None,
        option("Resume an interrupted run: its folder. Takes no other option.", "--resume"),
    ] = None,
) -> None:
    """Train, evaluate and save a sparse policy. Without arguments: SAC, RigL, 90 %, Pendulum-v1."""
    if resumed is not None:
        _reject_other_options(context)
        from sb3_sparse.zoo.training import resume

        _follow(f"Resuming {resumed}", partial(resume, resumed))
        return
    run = run_spec(
        context,
        algo,
        env,
        hyperparams,
        gym_packages,
        method=method,
        sparsity=sparsity,
        distribution=distribution,
        match_params=match_params,
        seed=seed,
        n_timesteps=n_timesteps,
        n_envs=n_envs,
        conf_file=conf_file,
        eval_freq=eval_freq,
        eval_episodes=eval_episodes,
        device=device,
    )
    headline = _headline(run)  # reports mistyped names before torch is imported
    from sb3_sparse.zoo.training import train

    _follow(headline, partial(train, run, log_folder, tensorboard_log=tensorboard_log))


def _follow(headline: str, engine: Callable[..., Outcome]) -> None:
    """Show a training while it runs, and its results.

    :param headline: printed when the training begins
    :param engine: trains, given a ``watch``
    """
    from sb3_sparse.cli.progress.train import TrainingProgress

    progress = TrainingProgress(console, headline)
    try:
        outcome = engine(watch=progress)
    except KeyboardInterrupt:
        progress.close()
        if progress.folder is None:
            say("Interrupted before the run began; no files were left behind.")
        else:
            say("Interrupted. Resume from the last checkpoint with:")
            say(command("train", "--resume", progress.folder))
        raise typer.Exit(INTERRUPTED) from None
    finally:
        progress.close()
    if not outcome.finished:
        say(f"Stopped after {outcome.model.num_timesteps} steps. Resume with:")
        say(command("train", "--resume", outcome.folder))
        raise typer.Exit(INTERRUPTED)
    tell(outcome)


def _headline(run: RunSpec) -> str:
    settings = run.settings()
    kwargs, method = settings.policy_kwargs, run.name_of(settings)
    if run.match_params is not None:
        how = f"dense with the parameters of {run.match_params:.0%}"
    elif method == "dense":
        how = method
    else:
        sparsity = kwargs["sparsity"]
        share = f"{sparsity:.0%}" if isinstance(sparsity, float) else str(sparsity)
        how = f"{method} at {share} ({kwargs.get('distribution', 'erk').upper()})"
    return f"Training {run.algo.upper()} on {run.env_id}, {how}, seed {run.seed}"


def _reject_other_options(context: typer.Context) -> None:
    """Reject options beside ``--resume``: a resumed run keeps all of its settings."""
    given = [
        name
        for name in context.params
        if (source := context.get_parameter_source(name)) is not None
        and source.name == "COMMANDLINE"
    ]
    others = [f"--{name.replace('_', '-')}" for name in given if name != "resumed"]
    if others or context.args:
        raise ConfigError(
            f"--resume takes all settings from the run; drop {' '.join([*others, *context.args])}"
        )
