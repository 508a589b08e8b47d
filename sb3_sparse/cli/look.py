"""``sb3-sparse enjoy`` and ``inspect``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sb3_sparse.cli.common import (
    Best,
    GymPackages,
    ModelAlgo,
    ModelEnv,
    Statistics,
    console,
    option,
    print_score,
    say,
)
from sb3_sparse.pages.numbers import counted


def enjoy_command(
    model: Annotated[Path, typer.Argument(help="A run's folder, or a zip saved by SB3.")],
    episodes: Annotated[int, option("How many episodes.", "--episodes", "-n")] = 20,
    best: Best = False,
    video: Annotated[bool, option("Record a video of the first 1000 steps.", "--video")] = False,
    seed: Annotated[int, option("Seed of the environment.")] = 0,
    env: ModelEnv = None,
    algo: ModelAlgo = None,
    vecnormalize: Statistics = None,
    gym_packages: GymPackages = None,
) -> None:
    """Evaluate a saved policy, and optionally record a video."""
    from sb3_sparse.cli.progress.train import EpisodesProgress
    from sb3_sparse.zoo.scoring import enjoy

    progress = EpisodesProgress(console)
    what = "Filming" if video else "Playing"
    try:
        score = enjoy(
            model,
            episodes,
            best,
            video,
            seed,
            gym_packages or [],
            algo=algo,
            env_id=env,
            vecnormalize=vecnormalize,
            on_episode=lambda done: progress(what, done, episodes),
        )
    finally:
        progress.close()
    say(f"Return over {counted(score.episodes, 'episode')}:")
    whose = ("Best policy:" if best else "Last policy:") if model.is_dir() else "Policy:"
    print_score(whose, score.mean_return, score.std_return, score.model)
    for path in score.videos:
        say(f"Video: {path}")


def inspect_command(
    model: Annotated[Path, typer.Argument(help="A run's folder, or a model saved by SB3 (.zip).")],
    best: Best = False,
) -> None:
    """Print the layers of a saved sparse model, and how each of them computes."""
    from sb3_sparse.zoo.inspection import inspect_model

    say(inspect_model(model, best))
