"""Watching and scoring what a run has trained."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecVideoRecorder

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.zoo.environments import (
    import_packages,
    is_atari,
    known_environment,
    package_names,
)
from sb3_sparse.zoo.experiment import envs_of_run, load_for_prediction, quiet
from sb3_sparse.zoo.saved import arguments_of, environment_in, model_in

VIDEO_STEPS = 1000


@dataclass(frozen=True)
class Score:
    """What an evaluation found.

    :param model: file of the policy
    :param mean_return: mean episode return
    :param std_return: its standard deviation over episodes
    :param episodes: how many
    :param videos: the videos of this run
    """

    model: Path
    mean_return: float
    std_return: float
    episodes: int
    videos: tuple[Path, ...]


def enjoy(
    folder: Path,
    episodes: int = 20,
    best: bool = False,
    video: bool = False,
    seed: int = 0,
    gym_packages: Sequence[str] = (),
) -> Score:
    """Evaluate a run's policy, deterministically (but for Atari games), as rl-zoo does.

    :param folder: of a run, of ``sb3-sparse train`` or of ``rl_zoo3.train``
    :param episodes: how many, 1 or more
    :param best: the best policy instead of the last
    :param video: record the first 1000 steps in ``<folder>/videos``
    :param seed: of the environment
    :param gym_packages: modules that register environments, beside those that the run names
    :raises ConfigError: if there is no run or no such model in it
    """
    if episodes < 1:
        raise ConfigError(f"episodes must be 1 or more, got {episodes}")
    arguments = arguments_of(folder)
    algo = arguments["algo"]
    env_id, packages = environment_in(arguments)
    assert env_id is not None
    import_packages(package_names([*packages, *gym_packages]))
    known_environment(env_id)
    env_name = env_id.replace("/", "-")
    path = model_in(folder, env_id, best)
    if video and importlib.util.find_spec("moviepy") is None:
        raise MissingExtra("recording a video", "video")
    if video and sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo's way to render without a display
    set_random_seed(seed)
    env_kwargs: dict[str, Any] = dict(arguments.get("env_kwargs") or {})
    if video:
        env_kwargs["render_mode"] = "rgb_array"
    with quiet():
        env = envs_of_run(env_id, folder / env_name, env_kwargs, seed)
        model = load_for_prediction(algo, path)
        if video:
            env = VecVideoRecorder(
                env,
                str(folder / "videos"),
                record_video_trigger=lambda step: step == 0,
                video_length=VIDEO_STEPS,
                name_prefix=path.stem,
            )
    try:
        with quiet():
            mean, std = evaluate_policy(
                model, env, n_eval_episodes=episodes, deterministic=not is_atari(env_id)
            )
    except Exception as error:
        if not video:
            raise
        raise ConfigError(
            f"{env_id} could not be filmed: {type(error).__name__}: {error}. It must render "
            "'rgb_array'; MuJoCo without a display needs MUJOCO_GL=egl or osmesa and its library"
        ) from error
    finally:
        with quiet():
            env.close()
    assert not isinstance(mean, list)
    assert not isinstance(std, list)
    videos = tuple(sorted((folder / "videos").glob(f"{path.stem}*"))) if video else ()
    return Score(path, float(mean), float(std), episodes, videos)
