"""Environments to train a saved model on in, and files that make the outcome look like a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
)

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.policies.saving import BROKEN_PICKLE
from sb3_sparse.zoo.environments import import_packages, is_atari, known_environment
from sb3_sparse.zoo.experiment import quiet, saved_settings
from sb3_sparse.zoo.saved import Saved, arguments_of, read_zip

try:
    from rl_zoo3.utils import create_test_env
except ImportError as error:
    raise MissingExtra("training environments", "zoo") from error

EVALUATION_ENVS = 10


def training_envs(saved: Saved, n_envs: int | None, seed: int) -> VecEnv:
    """Environments with the wrappers, stacking and normalisation that the model was trained with.

    :param n_envs: None: as many as it was trained in
    :param seed: of the environments
    :raises ConfigError: if the environment is not known, or not to be found
    """
    if n_envs is None:
        n_envs = int(read_zip(saved.path)[0]["n_envs"])
    if not 0 <= seed < 2**31:
        raise ConfigError(f"the seed must lie in [0, 2^31), got {seed}")
    if n_envs < 1:
        raise ConfigError(f"n_envs must be 1 or more, got {n_envs}")
    return _envs(saved, n_envs, seed, training=True)


def evaluation_envs(saved: Saved, episodes: int, seed: int) -> VecEnv:
    """The same for evaluation: true rewards, and statistics that stay as they are.

    :param episodes: of one evaluation
    :param seed: of the environments
    :raises ConfigError: if the environment is not known, or not to be found
    """
    env_id = environment_of(saved)
    # Atari's episodes end with each life, in the middle of a game that several would not leave.
    n_envs = 1 if is_atari(env_id) else max(1, min(EVALUATION_ENVS, episodes))
    return _envs(saved, n_envs, seed, training=False)


def evaluated_deterministically(saved: Saved) -> bool:
    """Whether rl-zoo evaluates such a model deterministically."""
    return not is_atari(environment_of(saved))


def environment_of(saved: Saved) -> str:
    """The environment's id, which is registered.

    :raises ConfigError: if the environment is not known, or not to be found
    """
    if saved.env_id is None:
        raise ConfigError(
            f"{saved.path} does not say what it was trained in; give --env, e.g. --env CartPole-v1"
        )
    import_packages(saved.gym_packages)
    known_environment(saved.env_id)
    return saved.env_id


def write_run_files(saved: Saved, folder: Path) -> None:
    """Write the files by which rl-zoo and ``sb3-sparse enjoy`` know a run.

    :param folder: the run's own; the model will be ``<env>.zip`` in it
    """
    env_id = environment_of(saved)
    params = folder / env_id.replace("/", "-")
    params.mkdir(parents=True, exist_ok=True)
    arguments: dict[str, Any] = {"env_kwargs": None, "seed": 0}
    settings = yaml.dump({"normalize": saved.vecnormalize is not None})
    if saved.params is not None:
        arguments = arguments_of(saved.params.parent)
        settings = (saved.params / "config.yml").read_text()
    arguments |= {"algo": saved.algo, "env": env_id, "gym_packages": list(saved.gym_packages)}
    (params / "args.yml").write_text(yaml.dump(arguments))
    (params / "config.yml").write_text(settings)


def _envs(saved: Saved, n_envs: int, seed: int, training: bool) -> VecEnv:
    env_id = environment_of(saved)
    settings: dict[str, Any] = {}
    env_kwargs: dict[str, Any] = {}
    if saved.params is not None:
        settings = saved_settings(saved.params)
        asked = arguments_of(saved.params.parent).get("env_kwargs")
        env_kwargs = {**settings.pop("env_kwargs", {}), **(asked or {})}
    with quiet():
        envs: VecEnv = create_test_env(
            env_id,
            n_envs=n_envs,
            seed=seed,
            should_render=False,
            hyperparams=settings,
            env_kwargs=env_kwargs,
            vec_env_cls=DummyVecEnv,
        )
    if saved.vecnormalize is not None:
        try:
            envs = VecNormalize.load(str(saved.vecnormalize), envs)
        except BROKEN_PICKLE as error:
            raise ConfigError(
                f"{saved.vecnormalize} does not hold what VecNormalize saved for {env_id}: {error}"
            ) from error
        envs.training = training
        envs.norm_reward = training and envs.norm_reward
    if settings.get("frame_stack"):
        envs = VecFrameStack(envs, settings["frame_stack"])
    return envs
