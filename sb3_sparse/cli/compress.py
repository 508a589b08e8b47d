"""``sb3-sparse compress``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
    option,
    say,
)
from sb3_sparse.errors import command


def compress_command(
    model: Annotated[
        Path,
        typer.Argument(help="A run's folder, or a model saved by SB3 (.zip); dense or sparse."),
    ],
    max_drop: Annotated[
        float | None,
        option("Largest drop of the mean return, as a share of it.", shown="0.03"),
    ] = None,
    sparsity: Annotated[
        float | None,
        option("End at this sparsity of the acting network instead.", shown=False),
    ] = None,
    distribution: Annotated[
        str | None, option("erk, er or uniform.", shown="a sparse model's own, else erk")
    ] = None,
    env: ModelEnv = None,
    gym_packages: GymPackages = None,
    algo: ModelAlgo = None,
    vecnormalize: Statistics = None,
    best: Best = False,
    steps: Annotated[
        int | None,
        option("Environment steps of each fine-tuning.", shown="5% of the model's, 10000 or more"),
    ] = None,
    n_envs: Annotated[
        int | None, option("Environments to fine-tune in.", shown="as it was trained in")
    ] = None,
    eval_episodes: Annotated[int, option("Episodes of one evaluation.")] = 50,
    seed: Annotated[int, option("Seed of everything.")] = 0,
    out: Annotated[Path | None, option("Folder.", shown="MODEL-compressed, beside it")] = None,
) -> None:
    """Make a trained model as sparse as its return allows, or as sparse as you ask for.

    The same command resumes an interrupted compression.
    """
    from sb3_sparse.compress import compress_model
    from sb3_sparse.zoo.computing import use_few_threads
    from sb3_sparse.zoo.folder import RunFolder, env_name
    from sb3_sparse.zoo.saved import SavedModel

    saved = SavedModel.find(
        model,
        best=best,
        algo=algo,
        env_id=env,
        vecnormalize=vecnormalize,
        gym_packages=gym_packages or [],
    )
    env_id = saved.environment
    folder = out or _default_folder(model, sparsity)
    training = saved.training_envs(n_envs, seed)
    evaluation = saved.evaluation_envs(eval_episodes, seed)
    try:
        trained = saved.load(training)
        trained.verbose, trained.tensorboard_log = 0, None
        use_few_threads(trained.observation_space)
        say(f"Compressing {saved.path} ({saved.algo.upper()} on {env_id}) into {folder}")
        folder.mkdir(parents=True, exist_ok=True)
        with RunFolder(folder).locked(), _interruptible():
            outcome = compress_model(
                trained,
                evaluation,
                folder,
                max_drop=max_drop,
                sparsity=sparsity,
                steps=steps,
                episodes=eval_episodes,
                seed=seed,
                deterministic=saved.acts_deterministically,
                distribution=distribution,
                name=env_name(env_id),
                say=say,
            )
            saved.write_run_files(folder)
    except KeyboardInterrupt:
        say("Interrupted. Finished levels are kept; give the same command to resume.")
        raise typer.Exit(INTERRUPTED) from None
    finally:
        training.close()
        evaluation.close()
        with suppress(OSError):
            folder.rmdir()  # which only succeeds if it is empty, after an error
    say(outcome)
    say(f"Model: {outcome.path}")
    say("Look at it, or export it:")
    say(command("enjoy", folder))
    say(command("inspect", outcome.path))
    say(command("export", folder, "--to", "c", "policy.c"))


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt anew where it came while torch wrote a file.

    torch then raises an error of its own about the file, which is not whole.
    """
    try:
        yield
    except RuntimeError as error:
        if isinstance(error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise


def _default_folder(model: Path, sparsity: float | None) -> Path:
    """Name a folder beside the model, a different one for each sparsity."""
    name = model.resolve().name.removesuffix(".zip")
    asked = "" if sparsity is None else f"-{sparsity:g}"
    return model.parent / f"{name}-compressed{asked}"
