"""Makes a saved model's environments with noise on their observations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.analysis import feature_std
from sb3_sparse.zoo.saved import SavedModel

NOISE_ENVS = 10
SEED = 30_000


def noisy_envs(saved: SavedModel, model: BaseAlgorithm) -> Callable[[float], VecEnv]:
    """Return a function that makes ten of a model's environments with noise of a given strength.

    Pixels get ``round(N(0, sigma))`` before stacking; features of vectors ``N(0, sigma * std)``
    before normalisation, with the std that they have while this policy acts without noise.

    :param model: the model, loaded from ``saved``
    """

    def make(wrappers: list[dict[str, Any]]) -> VecEnv:
        return saved.envs(NOISE_ENVS, SEED, wrappers=wrappers)

    if is_image_space(model.observation_space):
        return lambda sigma: make([{"sb3_sparse.wrappers.PixelNoise": {"sigma": sigma}}])
    envs = make([])
    std = feature_std(model, envs).tolist()
    envs.close()
    return lambda sigma: make(
        [{"sb3_sparse.wrappers.ObservationNoise": {"sigma": sigma, "std": std}}]
    )
