"""Return of a trained policy under noise on what it observes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecFrameStack,
    VecMonitor,
    is_vecenv_wrapped,
    unwrap_vec_normalize,
)

from sb3_sparse.analysis.batches import own_randomness
from sb3_sparse.errors import ConfigError
from sb3_sparse.loading.statistics import load_statistics
from sb3_sparse.wrappers import ObservationNoise, PixelNoise

Wrap = Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]


@dataclass(frozen=True)
class NoiseRobustness:
    """Returns under noise.

    :param returns: of the episodes, in the environment's own reward, by sigma and seed
    """

    returns: Mapping[tuple[float, int], tuple[float, ...]]

    def rows(self) -> Iterator[tuple[float, int, int, float]]:
        """Rows ``sigma, seed, episode, return``."""
        for (sigma, seed), returns in self.returns.items():
            for episode, value in enumerate(returns):
                yield sigma, seed, episode, value

    def means(self) -> dict[float, float]:
        """Mean return over seeds and episodes, by sigma."""
        found: dict[float, list[float]] = {}
        for sigma, _, _, value in self.rows():
            found.setdefault(sigma, []).append(value)
        return {sigma: float(np.mean(values)) for sigma, values in found.items()}

    def __str__(self) -> str:
        return "\n".join(f"sigma {sigma:g}: {mean:.2f}" for sigma, mean in self.means().items())


def noise_robustness(
    model: BaseAlgorithm,
    make_envs: Callable[[float], VecEnv],
    sigmas: Sequence[float] = range(31),
    n_episodes: int = 10,
    seeds: Sequence[int] = (0,),
    deterministic: bool = True,
) -> NoiseRobustness:
    """Evaluate a policy at several strengths of noise.

    Each environment plays its share of the episodes to the end, so that short ones are not
    preferred, and the return is the Monitor's, before rewards are clipped or normalised. The same
    seed gives the same episodes for every model. Nothing of the model changes, nor the global
    generators of NumPy and torch.

    :param model: trained model
    :param make_envs: environments with noise of a sigma; they are closed here
    :param sigmas: strengths; the default is that of images, in grey levels. Of vectors the unit is
        each feature's standard deviation: take e.g. 0, 0.1, ..., 1
    :param n_episodes: episodes for each sigma and seed
    :param seeds: seeds of environments, noise and (if it is random) policy
    :param deterministic: whether the policy takes its likeliest action
    :raises ConfigError: for values that are not allowed, and for environments without a Monitor or
        whose VecNormalize still learns

    Source: arXiv:2206.10369, section on noise robustness.
    """
    if n_episodes < 1 or not sigmas or not seeds:
        raise ConfigError(
            "noise_robustness needs sigmas, seeds and 1 or more episodes, got "
            f"{list(sigmas)}, {list(seeds)} and {n_episodes}"
        )
    for name, values in {"sigmas": sigmas, "seeds": seeds}.items():
        if len(set(values)) < len(values):
            raise ConfigError(f"one of the {name} stands twice in {list(values)}")
    returns: dict[tuple[float, int], tuple[float, ...]] = {}
    for sigma in sigmas:
        envs = make_envs(sigma)
        try:
            _check(envs)
            for seed in seeds:
                with _seeded(model, seed):
                    envs.seed(seed)
                    got, _ = evaluate_policy(
                        model, envs, n_episodes, deterministic, return_episode_rewards=True
                    )
                assert isinstance(got, list)
                returns[sigma, seed] = tuple(map(float, got))
        finally:
            envs.close()
    return NoiseRobustness(returns)


def _check(envs: VecEnv) -> None:
    if not is_vecenv_wrapped(envs, VecMonitor) and not all(envs.env_is_wrapped(Monitor)):
        raise ConfigError(
            "noise_robustness takes returns from SB3's Monitor, which these environments lack; "
            "make them with make_vec_env or noisy_vec_env"
        )
    normalize = unwrap_vec_normalize(envs)
    if normalize is not None and normalize.training:
        raise ConfigError(
            "the VecNormalize of these environments still learns, from noise; set its training to "
            "False"
        )


@contextmanager
def _seeded(model: BaseAlgorithm, seed: int) -> Iterator[None]:
    """Make a random policy's actions depend on the seed; DQN's come from its action space."""
    space = model.action_space
    before = space.np_random.bit_generator.state
    with own_randomness(seed, model.device):
        try:
            space.np_random.bit_generator.state = np.random.default_rng(seed).bit_generator.state
            yield
        finally:
            space.np_random.bit_generator.state = before


def noisy_vec_env(
    env_id: str | Callable[..., gym.Env[Any, Any]],
    sigma: float,
    n_envs: int = 1,
    seed: int | None = None,
    std: Sequence[float] | None = None,
    *,
    wrapper: Wrap | None = None,
    frame_stack: int = 0,
    normalize: str | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> VecEnv:
    """Environments with noise on what they show.

    Images get ``round(N(0, sigma))`` in every pixel of every frame, before it is stacked and
    normalised, saturating at 0 and 255; reset frames too. Vectors get ``N(0, sigma * std)``.

    :param env_id: as of SB3's ``make_vec_env``
    :param sigma: images: grey levels, 0 to 30 in the paper; vectors: in units of each feature's
        standard deviation, so that 1 is noise as large as the signal
    :param n_envs: environments
    :param seed: seed of the first
    :param std: of each feature, which only vectors have: see :func:`feature_std`
    :param wrapper: below the noise, e.g. SB3's ``AtariWrapper``
    :param frame_stack: frames to stack; 0: none
    :param normalize: saved ``VecNormalize``, put above the noise and frozen
    :param env_kwargs: for the environment
    :raises ConfigError: for observations that are neither, vectors without std, images with one
    """

    def noisy(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        env = env if wrapper is None else wrapper(env)
        if env.observation_space.dtype == np.uint8:
            if std is not None:
                raise ConfigError("std is of vectors; noise on images is in grey levels")
            return PixelNoise(env, sigma)
        if std is None:
            raise ConfigError(
                "noise on vectors goes by the std of each feature; give std=feature_std(model, "
                "envs) with environments without noise"
            )
        return ObservationNoise(env, sigma, std)

    envs: VecEnv = make_vec_env(
        env_id, n_envs=n_envs, seed=seed, wrapper_class=noisy, env_kwargs=env_kwargs
    )
    if normalize is not None:
        envs = load_statistics(Path(normalize), envs)
        envs.training = envs.norm_reward = False
    return VecFrameStack(envs, frame_stack) if frame_stack else envs


def feature_std(
    model: BaseAlgorithm, envs: VecEnv, steps: int = 2000, seed: int = 0
) -> NDArray[np.float64]:
    """Standard deviation of each feature while a policy acts, before normalisation.

    :param model: takes its likeliest actions
    :param envs: without noise; a ``VecNormalize`` must be frozen
    :param steps: environment steps of all environments together
    :param seed: of the environments
    :return: shape of an observation
    :raises ConfigError: for observations that are no vectors or images, or too few steps
    """
    if steps < 2 * envs.num_envs:
        raise ConfigError(f"{steps} steps are too few for {envs.num_envs} environments")
    if not isinstance(envs.observation_space, gym.spaces.Box):
        raise ConfigError(f"feature_std takes vectors, got {envs.observation_space}")
    normalize = unwrap_vec_normalize(envs)
    if normalize is not None and normalize.training:
        raise ConfigError("the VecNormalize of these environments still learns; set training=False")
    envs.seed(seed)
    observation = envs.reset()
    seen = []
    for _ in range(steps // envs.num_envs):
        raw = observation if normalize is None else normalize.get_original_obs()
        seen.append(np.array(raw, np.float64))
        assert isinstance(observation, np.ndarray)
        action, _ = model.predict(observation, deterministic=True)
        observation, _, _, _ = envs.step(action)
    std: NDArray[np.float64] = np.concatenate(seen).std(axis=0)
    return std
