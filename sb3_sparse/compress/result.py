"""The outcome of a compression."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sb3_sparse.compress.guard import Interval
from sb3_sparse.compress.search import Level


@dataclass(frozen=True)
class Compression:
    """The outcome of a compression; its returns are from episodes that had no part in choosing it.

    :param path: file of the compressed model
    :param network: name of the acting network, which was pruned
    :param sparsity: sparsity of every network
    :param nnz_before: active connections of the acting network before
    :param nnz: active connections of the acting network now
    :param baseline: return of the original model
    :param outcome: return of the compressed model
    :param change: change of the return, from pairs of episodes
    :param episodes: number of episodes that each model played
    :param levels: the sparsities that were tried

    Example::

        from stable_baselines3 import PPO
        from stable_baselines3.common.env_util import make_vec_env
        from sb3_sparse.compress import compress_model

        model = PPO("MlpPolicy", "CartPole-v1", n_steps=64).learn(64)
        envs = make_vec_env("CartPole-v1")
        print(compress_model(model, envs, "smaller", sparsity=0.5, steps=64, episodes=2))
    """

    path: Path
    network: str
    sparsity: Mapping[str, float]
    nnz_before: int
    nnz: int
    baseline: Interval
    outcome: Interval
    change: Interval
    episodes: int
    levels: tuple[Level, ...]

    def __str__(self) -> str:
        networks = ", ".join(f"{name} {value:.2%}" for name, value in self.sparsity.items())
        return "\n".join(
            [
                f"sparsity: {networks}",
                f"connections of the {self.network}: {self.nnz_before:,} before, {self.nnz:,} now",
                f"return: {self.baseline} before, {self.outcome} now, over {self.episodes} fresh "
                "episodes each, 95 % intervals",
                f"change: {self.change.share_of(self.baseline.mean)}",
            ]
        )
