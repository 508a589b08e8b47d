"""``sb3-sparse compress``."""

from __future__ import annotations

import shlex
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from sb3_sparse.cli.common import (
    INTERRUPTED,
    Best,
    GymPackages,
    ModelAlgo,
    ModelEnv,
    Statistics,
    console,
    text,
)


def compress(
    model: Annotated[
        Path,
        typer.Argument(help="A run's folder, or a model saved by SB3 (.zip); dense or sparse."),
    ],
    max_drop: Annotated[
        float | None,
        text("Largest drop of the mean return, as a share of it.", shown="0.03"),
    ] = None,
    sparsity: Annotated[
        float | None,
        text("End at this sparsity of the acting network instead.", shown=False),
    ] = None,
    distribution: Annotated[
        str | None, text("erk, er or uniform.", shown="a sparse model's own, else erk")
    ] = None,
    env: ModelEnv = None,
    gym_packages: GymPackages = None,
    algo: ModelAlgo = None,
    vecnormalize: Statistics = None,
    best: Best = False,
    steps: Annotated[
        int | None,
        text("Environment steps of each fine-tuning.", shown="5% of the model's, 10000 or more"),
    ] = None,
    n_envs: Annotated[
        int | None, text("Environments to fine-tune in.", shown="as it was trained in")
    ] = None,
    eval_episodes: Annotated[int, text("Episodes of one evaluation.")] = 50,
    seed: Annotated[int, text("Seed of everything.")] = 0,
    out: Annotated[Path | None, text("Folder.", shown="MODEL-compressed, beside it")] = None,
) -> None:
    """Make a trained model as sparse as its return allows, or as sparse as asked for.

    The same command goes on with an interrupted compression.
    """
    from sb3_sparse.compress import compress as run
    from sb3_sparse.zoo.checkpoint import locked
    from sb3_sparse.zoo.finetune import (
        environment_of,
        evaluated_deterministically,
        evaluation_envs,
        training_envs,
        write_run_files,
    )
    from sb3_sparse.zoo.saved import find_saved
    from sb3_sparse.zoo.speed import use_few_threads

    saved = find_saved(
        model,
        best=best,
        algo=algo,
        env_id=env,
        vecnormalize=vecnormalize,
        gym_packages=gym_packages or [],
    )
    env_id = environment_of(saved)
    folder = out or _default_folder(model, sparsity)
    training = training_envs(saved, n_envs, seed)
    evaluation = evaluation_envs(saved, eval_episodes, seed)
    try:
        trained = saved.load(training)
        trained.verbose, trained.tensorboard_log = 0, None
        use_few_threads(trained.observation_space)
        _say(f"Compressing {saved.path} ({saved.algo.upper()} on {env_id}) into {folder}")
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder):
            outcome = run(
                trained,
                evaluation,
                folder,
                max_drop=max_drop,
                sparsity=sparsity,
                steps=steps,
                episodes=eval_episodes,
                seed=seed,
                deterministic=evaluated_deterministically(saved),
                distribution=distribution,
                name=env_id.replace("/", "-"),
                say=_say,
            )
            write_run_files(saved, folder)
    except KeyboardInterrupt:
        _say("Interrupted. What was done is kept; the same command goes on.")
        raise typer.Exit(INTERRUPTED) from None
    finally:
        training.close()
        evaluation.close()
        with suppress(OSError):
            folder.rmdir()  # if it is empty, since something was refused
    _say(str(outcome))
    _say(f"Model: {outcome.path}")
    _say("Look at it, or take it elsewhere:")
    for command in (
        ["enjoy", str(folder)],
        ["inspect", str(outcome.path)],
        ["export", str(folder), "--to", "c", "policy.c"],
    ):
        _say(shlex.join(["sb3-sparse", *command]))


def _default_folder(model: Path, sparsity: float | None) -> Path:
    """Beside the model; another for each sparsity asked for."""
    name = model.resolve().name.removesuffix(".zip")
    asked = "" if sparsity is None else f"-{sparsity:g}"
    return model.parent / f"{name}-compressed{asked}"


def _say(line: str) -> None:
    console.print(line, soft_wrap=True)
