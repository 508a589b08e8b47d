"""A finished run's policy, and its environments with noise on what is observed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.analysis import feature_std
from sb3_sparse.zoo.experiment import envs_of_run, load_for_prediction, quiet
from sb3_sparse.zoo.saved import model_in

NOISE_ENVS = 10
SEED = 30_000


def noisy_envs(
    folder: Path, env_id: str, algo: str
) -> tuple[BaseAlgorithm, Callable[[float], VecEnv]]:
    """The last policy of a run, and what makes ten of its environments with noise.

    Pixels get ``round(N(0, sigma))`` before stacking; features of vectors ``N(0, sigma * std)``
    before normalisation, with the std that they have while this policy acts without noise.

    :param folder: of a finished run
    """
    model = load_for_prediction(algo, model_in(folder, env_id, best=False))
    params = folder / env_id.replace("/", "-")

    def make(wrappers: list[dict[str, Any]]) -> VecEnv:
        with quiet():
            return envs_of_run(env_id, params, {}, SEED, NOISE_ENVS, wrappers)

    if is_image_space(model.observation_space):
        return model, lambda sigma: make([{"sb3_sparse.wrappers.PixelNoise": {"sigma": sigma}}])
    envs = make([])
    std = feature_std(model, envs).tolist()
    envs.close()
    return model, lambda sigma: make(
        [{"sb3_sparse.wrappers.ObservationNoise": {"sigma": sigma, "std": std}}]
    )
