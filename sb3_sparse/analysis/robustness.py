"""Returns of a trained policy under noise on its observations."""

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

    Example::

        from sb3_sparse.analysis import NoiseRobustness

        table = NoiseRobustness({(0.0, 0): (500.0, 480.0), (0.5, 0): (120.0, 90.0)})
        assert table.means() == {0.0: 490.0, 0.5: 105.0}

    :param returns: returns of the episodes, in the environment's own reward, by sigma and seed
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

    Each environment plays its share of the episodes to the end, so that short episodes are not
    preferred. Returns are the Monitor's, before rewards are clipped or normalised. The same seed
    gives the same episodes for every model. The model does not change, nor do the global generators
    of NumPy and torch.

    :param model: trained model
    :param make_envs: makes environments with noise of a sigma; they are closed afterwards
    :param sigmas: strengths; the default is for images, in grey levels. For vectors the unit is
        each feature's standard deviation: take e.g. 0, 0.1, ..., 1
    :param n_episodes: episodes for each sigma and seed
    :param seeds: seeds of environments, noise and (if it is random) policy
    :param deterministic: whether the policy takes its most likely action
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
            raise ConfigError(f"one of the {name} is given twice in {list(values)}")
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
            "noise_robustness needs SB3's Monitor, which these environments lack; "
            "make them with make_vec_env or noisy_vec_env"
        )
    normalize = unwrap_vec_normalize(envs)
    if normalize is not None and normalize.training:
        raise ConfigError(
            "the VecNormalize of these environments still updates its statistics, from noise; set "
            "its training to False"
        )


@contextmanager
def _seeded(model: BaseAlgorithm, seed: int) -> Iterator[None]:
    """Let the actions of a random policy depend on the seed; DQN draws from its action space."""
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
    """Environments with noise on their observations.

    Images get ``round(N(0, sigma))`` in every pixel of every frame, also after a reset, before
    stacking and normalisation, saturating at 0 and 255. Vectors get ``N(0, sigma * std)``.

    :param env_id: as in SB3's ``make_vec_env``
    :param sigma: for images in grey levels, 0 to 30 in the paper; for vectors in units of each
        feature's standard deviation, so that 1 is noise as large as the signal
    :param n_envs: number of environments
    :param seed: seed of the first environment
    :param std: standard deviation of each feature, for vectors only: see :func:`feature_std`
    :param wrapper: applied below the noise, e.g. SB3's ``AtariWrapper``
    :param frame_stack: frames to stack; 0: none
    :param normalize: saved ``VecNormalize``, put above the noise and frozen
    :param env_kwargs: arguments of the environment
    :raises ConfigError: for other observations, vectors without ``std`` or images with it
    """

    def noisy(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        env = env if wrapper is None else wrapper(env)
        if env.observation_space.dtype == np.uint8:
            if std is not None:
                raise ConfigError("std is for vectors; noise on images is in grey levels")
            return PixelNoise(env, sigma)
        if std is None:
            raise ConfigError(
                "noise on vectors is in units of each feature's std; give std=feature_std(model, "
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

    :param model: takes its most likely actions
    :param envs: environments without noise; a ``VecNormalize`` must be frozen
    :param steps: environment steps of all environments together
    :param seed: seed of the environments
    :return: shape of an observation
    :raises ConfigError: for observations other than vectors and images, or too few steps
    """
    if steps < 2 * envs.num_envs:
        raise ConfigError(f"{steps} steps are too few for {envs.num_envs} environments")
    if not isinstance(envs.observation_space, gym.spaces.Box):
        raise ConfigError(f"feature_std takes vectors, got {envs.observation_space}")
    normalize = unwrap_vec_normalize(envs)
    if normalize is not None and normalize.training:
        raise ConfigError(
            "the VecNormalize of these environments still updates; set training=False"
        )
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
