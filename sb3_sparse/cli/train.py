"""``sb3-sparse train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sb3_sparse.cli.common import (
    INTERRUPTED,
    Algo,
    ConfFile,
    Device,
    Distribution,
    Env,
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
    print_score,
    text,
    values_and_packages,
)
from sb3_sparse.errors import ConfigError, command
from sb3_sparse.zoo.settings import method_of, parse_overrides
from sb3_sparse.zoo.spec import RunSpec

SHORT = 1e-3  # what a sparsity may miss by rounding


def train(
    context: typer.Context,
    algo: Algo = "dqn",
    env: Env = "CartPole-v1",
    method: Method = None,
    sparsity: Sparsity = None,
    distribution: Distribution = None,
    match_params: Annotated[
        float | None,
        text(
            "With --method dense: a dense network with as few parameters as this sparsity leaves."
        ),
    ] = None,
    seed: Annotated[int, text("Seed of everything.")] = 0,
    n_timesteps: Steps = None,
    n_envs: Envs = None,
    hyperparams: Hyperparams = None,
    conf_file: ConfFile = None,
    gym_packages: GymPackages = None,
    eval_freq: EvalFreq = None,
    eval_episodes: EvalEpisodes = None,
    device: Device = "auto",
    tensorboard_log: Annotated[
        str, text("Folder of TensorBoard's files.", "--tensorboard-log", "-tb")
    ] = "",
    log_folder: LogFolder = Path("logs"),
    resume: Annotated[
        Path | None, text("Go on with an interrupted run: its folder. Takes no other option.")
    ] = None,
) -> None:
    """Train, evaluate and save a sparse policy. Without arguments: DQN, RigL, 90 %, CartPole-v1."""
    run = None
    if resume is not None:
        _refuse_other_options(context)
    else:
        values, packages = values_and_packages(context.args, hyperparams, gym_packages)
        run = RunSpec(
            algo=algo.lower(),
            env_id=env,
            method=method,
            sparsity=sparsity,
            distribution=distribution,
            match_params=match_params,
            seed=seed,
            n_timesteps=n_timesteps,
            n_envs=n_envs,
            hyperparams=parse_overrides(values),
            conf_file=conf_file,
            eval_freq=eval_freq,
            eval_episodes=eval_episodes,
            device=device,
            gym_packages=tuple(packages),
        )
        run.config_entry()  # a mistyped name shall not wait for torch
    from sb3_sparse.zoo import training as engine
    from sb3_sparse.zoo.progress import TrainingProgress

    progress = TrainingProgress(console)
    try:
        if run is None:
            assert resume is not None
            console.print(f"Going on with {resume}", soft_wrap=True)
            outcome = engine.resume(resume, watch=progress)
        else:
            console.print(_headline(run))
            outcome = engine.train(run, log_folder, tensorboard_log=tensorboard_log, watch=progress)
    except KeyboardInterrupt:
        progress.close()
        if progress.folder is None:
            console.print("Interrupted before the run had begun; nothing is left of it.")
        else:
            console.print("Interrupted. Go on from the last checkpoint with:")
            console.print(command("train", "--resume", progress.folder), soft_wrap=True)
        raise typer.Exit(INTERRUPTED) from None
    finally:
        progress.close()
    if not outcome.finished:
        steps = outcome.model.num_timesteps
        console.print(f"Stopped after {steps} steps. Go on with:", soft_wrap=True)
        console.print(command("train", "--resume", outcome.folder), soft_wrap=True)
        raise typer.Exit(INTERRUPTED)
    results = outcome.results
    console.print(f"Sparsity {outcome.sparsity:.2%}. Return over {results[0].episodes} episodes:")
    for result in results:
        print_score(f"{result.what}:", result.mean_return, result.std_return, result.path)
    if outcome.sparsity < outcome.wanted_sparsity - SHORT:
        console.print(
            f"It was to reach {outcome.wanted_sparsity:.2%}: too few mask updates were due. Train "
            "longer, or with a smaller update_interval; reports leave this run out.",
            soft_wrap=True,
        )
    best = ["--best"] if len(results) > 1 else []
    console.print(
        "The best policy was chosen by other episodes. Look at it:" if best else "Look at it:"
    )
    for words in (["enjoy", outcome.folder, *best], ["inspect", results[-1].path]):
        console.print(command(*words), soft_wrap=True)


def _headline(run: RunSpec) -> str:
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
