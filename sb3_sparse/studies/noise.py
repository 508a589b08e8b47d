"""A finished run's policy, and its environments with noise on what is observed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.analysis import feature_std
from sb3_sparse.zoo.finetune import envs_of
from sb3_sparse.zoo.saved import find_saved

NOISE_ENVS = 10
SEED = 30_000


def noisy_envs(folder: Path) -> tuple[BaseAlgorithm, Callable[[float], VecEnv]]:
    """The last policy of a run, and what makes ten of its environments with noise.

    Pixels get ``round(N(0, sigma))`` before stacking; features of vectors ``N(0, sigma * std)``
    before normalisation, with the std that they have while this policy acts without noise.

    :param folder: of a finished run
    """
    saved = find_saved(folder)
    model = saved.load()

    def make(wrappers: list[dict[str, Any]]) -> VecEnv:
        return envs_of(saved, NOISE_ENVS, SEED, wrappers=wrappers)

    if is_image_space(model.observation_space):
        return model, lambda sigma: make([{"sb3_sparse.wrappers.PixelNoise": {"sigma": sigma}}])
    envs = make([])
    std = feature_std(model, envs).tolist()
    envs.close()
    return model, lambda sigma: make(
        [{"sb3_sparse.wrappers.ObservationNoise": {"sigma": sigma, "std": std}}]
    )
