"""Evaluates a saved model, and records videos of it."""

from __future__ import annotations

import importlib.util
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecVideoRecorder

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.zoo.manager import quiet
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.watch import counting

VIDEO_STEPS = 1000


@dataclass(frozen=True)
class Score:
    """The result of an evaluation.

    :param model: the policy's zip
    :param mean_return: mean episode return
    :param std_return: its standard deviation over episodes
    :param episodes: number of episodes
    :param videos: videos of the policy
    """

    model: Path
    mean_return: float
    std_return: float
    episodes: int
    videos: tuple[Path, ...]


def enjoy(
    path: Path,
    episodes: int = 20,
    best: bool = False,
    video: bool = False,
    seed: int = 0,
    gym_packages: Sequence[str] = (),
    *,
    algo: str | None = None,
    env_id: str | None = None,
    vecnormalize: Path | None = None,
    on_episode: Callable[[int], None] = lambda done: None,
) -> Score:
    """Evaluate a saved policy as rl-zoo does: deterministically, except in Atari games.

    :param path: a run's folder, of ``sb3-sparse train`` or of ``rl_zoo3.train``, or a zip of SB3
    :param episodes: number of episodes, 1 or more
    :param best: take a folder's best policy instead of its last
    :param video: record the first 1000 steps in a folder ``videos`` beside the zip
    :param seed: seed of the environment
    :param gym_packages: further modules that register environments or algorithms
    :param algo: algorithm; None: the one that the run's folder or the file names
    :param env_id: environment; None: the one that the run's folder names
    :param vecnormalize: statistics of a VecNormalize; None: those in the run's folder
    :param on_episode: called with the number of finished episodes, at the start and after each
    :raises ConfigError: if the model, or a file that belongs to it, is missing
    :raises CorruptStateError: if a file is damaged
    :raises Diverged: if a network is not finite
    """
    if episodes < 1:
        raise ConfigError(f"episodes must be 1 or more, got {episodes}")
    if video and sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # They let MuJoCo render and pygame draw without a display. dm_control reads the first when
        # it is imported, i.e. when the environment is looked up.
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    saved = SavedModel.find(
        path,
        best=best,
        algo=algo,
        env_id=env_id,
        vecnormalize=vecnormalize,
        gym_packages=gym_packages,
    )
    saved.environment  # noqa: B018  # rejected before anything is made
    if video and importlib.util.find_spec("moviepy") is None:
        raise MissingExtra("recording a video", "video")
    set_random_seed(seed)
    kwargs: dict[str, Any] = {"render_mode": "rgb_array"} if video else {}
    try:
        env = saved.envs(1, seed, env_kwargs=kwargs)
    except ConfigError as error:
        if not video:
            raise
        raise ConfigError(
            f"{error}. For a video its constructor must take render_mode='rgb_array', and its "
            "render() return images"
        ) from error
    folder = saved.path.parent / "videos"
    try:
        model = saved.load()
        saved.check_suits(env, model.observation_space, model.action_space)
        with _filmed(saved, video), quiet():
            if video:
                env = VecVideoRecorder(
                    env,
                    str(folder),
                    record_video_trigger=lambda step: step == 0,
                    video_length=VIDEO_STEPS,
                    name_prefix=saved.path.stem,
                )
            on_episode(0)
            mean, std = evaluate_policy(
                model,
                env,
                n_eval_episodes=episodes,
                deterministic=saved.acts_deterministically,
                callback=counting(on_episode),
            )
            on_episode(episodes)
    finally:
        with _filmed(saved, video), quiet():  # closing may write the video
            env.close()
    assert not isinstance(mean, list)
    assert not isinstance(std, list)
    videos = tuple(sorted(folder.glob(f"{saved.path.stem}*"))) if video else ()
    return Score(saved.path, float(mean), float(std), episodes, videos)


@contextmanager
def _filmed(saved: SavedModel, video: bool) -> Iterator[None]:
    """Report errors while filming as errors about the video.

    MoviePy's progress bar, which always goes to stderr, is dropped.
    """
    try:
        with redirect_stderr(io.StringIO()) if video else nullcontext():
            yield
    except gym.error.DependencyNotInstalled as error:
        if not video or "pygame" not in str(error):
            raise
        raise MissingExtra("recording a video", "video") from error
    except OSError:
        raise  # the error already names the folder that cannot be written to
    except Exception as error:
        if not video:
            raise
        raise ConfigError(
            f"{saved.env_id} could not be filmed: {type(error).__name__}: {error}. It must render "
            "'rgb_array'; MuJoCo without a display needs MUJOCO_GL=egl or osmesa and its library"
        ) from error
