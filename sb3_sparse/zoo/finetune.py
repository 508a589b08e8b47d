"""Environments to train a saved model on in, and files that make the outcome look like a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecFrameStack

from sb3_sparse.errors import ConfigError, MissingExtra, SparsityError
from sb3_sparse.loading.statistics import load_statistics
from sb3_sparse.loading.text import read_text
from sb3_sparse.loading.zips import look_into
from sb3_sparse.loading.zooyaml import NotBuilt
from sb3_sparse.policies.arguments import import_path
from sb3_sparse.sparsity.numeric import is_whole
from sb3_sparse.zoo.environments import import_packages, is_atari, known_environment
from sb3_sparse.zoo.folder import CONFIG, RESTORE, arguments_of, params_of
from sb3_sparse.zoo.manager import quiet
from sb3_sparse.zoo.mujoco import mujoco_warns_once
from sb3_sparse.zoo.prepare import explained
from sb3_sparse.zoo.saved import Saved

try:
    from rl_zoo3.utils import create_test_env
except ImportError as error:
    raise MissingExtra("training environments", "zoo") from error

EVALUATION_ENVS = 10


def training_envs(saved: Saved, n_envs: int | None, seed: int) -> VecEnv:
    """Environments with the wrappers, stacking and normalisation that the model was trained with.

    :param n_envs: None: as many as it was trained in
    :param seed: of the environments
    :raises ConfigError: if the environment is not known, not to be found, or cannot be made
    :raises CorruptStateError: if a file that belongs to the model is damaged
    """
    if n_envs is None:
        n_envs = look_into(saved.path).data.get("n_envs")
    if not 0 <= seed < 2**31:
        raise ConfigError(f"the seed must lie in [0, 2^31), got {seed}")
    if n_envs is None or not is_whole(n_envs) or n_envs < 1:
        raise ConfigError(f"n_envs must be 1 or more, got {n_envs!r}; give --n-envs")
    return envs_of(saved, n_envs, seed, training=True)


def evaluation_envs(saved: Saved, episodes: int, seed: int) -> VecEnv:
    """The same for evaluation: true rewards, and statistics that stay as they are.

    :param episodes: of one evaluation
    :param seed: of the environments
    :raises ConfigError: as :func:`training_envs`
    :raises CorruptStateError: as :func:`training_envs`
    """
    env_id = environment_of(saved)
    # Atari's episodes end with each life, in the middle of a game that several would not leave.
    n_envs = 1 if is_atari(env_id) else max(1, min(EVALUATION_ENVS, episodes))
    return envs_of(saved, n_envs, seed)


def envs_of(
    saved: Saved,
    n_envs: int,
    seed: int,
    *,
    training: bool = False,
    wrappers: Sequence[Mapping[str, Any]] = (),
    env_kwargs: Mapping[str, Any] | None = None,
) -> VecEnv:
    """Environments with the wrappers, stacking and normalisation that a model was trained with.

    :param n_envs: how many side by side, in this process
    :param training: whether rewards are normalised and statistics move on
    :param wrappers: further ones, around those of the run but below stacking and normalisation;
        each a path to its arguments, as in rl-zoo's ``env_wrapper``
    :param env_kwargs: arguments of the environment beside those of the run
    :raises ConfigError: as :func:`training_envs`
    :raises CorruptStateError: as :func:`training_envs`
    """
    env_id = environment_of(saved)
    settings = dict(saved.settings)
    kwargs = dict(settings.pop("env_kwargs", {}))
    if saved.params is not None:
        kwargs |= arguments_of(saved.params.parent).get("env_kwargs") or {}
    kwargs |= env_kwargs or {}
    if wrappers:
        own = settings.get("env_wrapper") or []
        settings["env_wrapper"] = [*(own if isinstance(own, list) else [own]), *wrappers]
    where = "" if saved.params is None else f" with the wrappers and arguments in {saved.params}"
    failure = f"{env_id} cannot be made{where}"
    with explained(failure, env_id), quiet(), mujoco_warns_once(env_id):
        check_wrappers(settings)
        envs: VecEnv = create_test_env(
            env_id,
            n_envs=n_envs,
            seed=seed,
            should_render=False,
            hyperparams=settings,
            env_kwargs=kwargs,
            vec_env_cls=DummyVecEnv,
        )
    try:
        if saved.vecnormalize is not None:
            envs = load_statistics(saved.vecnormalize, envs)
            envs.training = training
            envs.norm_reward = training and envs.norm_reward
        if settings.get("frame_stack"):
            with explained(f"frames of {env_id} cannot be stacked", env_id):
                envs = VecFrameStack(envs, settings["frame_stack"])
    except SparsityError:
        envs.close()
        raise
    return envs


def check_wrappers(settings: Mapping[str, Any]) -> None:
    """Refuse a wrapper that is none: calling whatever a file names would run anything.

    :raises ConfigError: if so
    """
    for name, kind in (("env_wrapper", gym.Wrapper), ("vec_env_wrapper", VecEnvWrapper)):
        given = settings.get(name) or []
        for one in given if isinstance(given, list) else [given]:
            path = one if isinstance(one, str) else next(iter(one))
            found = import_path(path)
            if not (isinstance(found, type) and issubclass(found, kind)):
                raise ConfigError(
                    f"{name} {path} is no subclass of {kind.__module__}.{kind.__name__}; make it "
                    "one"
                )


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
    params = params_of(folder, env_id)
    params.mkdir(parents=True, exist_ok=True)
    arguments: dict[str, Any] = {"env_kwargs": None, "seed": 0}
    normalized = saved.vecnormalize is not None
    settings = yaml.dump({"normalize": normalized})
    if saved.params is not None:
        known = arguments_of(saved.params.parent)
        arguments = {key: one for key, one in known.items() if not isinstance(one, NotBuilt)}
        if saved.settings:
            settings = read_text(saved.params / CONFIG, "YAML file of a run", RESTORE)
            if saved.settings["normalize"] != normalized:  # statistics were given for it
                settings = yaml.dump({**saved.settings, "normalize": normalized})
    arguments |= {"algo": saved.algo, "env": env_id, "gym_packages": list(saved.gym_packages)}
    (params / "args.yml").write_text(yaml.dump(arguments), encoding="utf-8")
    (params / CONFIG).write_text(settings, encoding="utf-8")
