"""Keeping the best policy of a run."""

from __future__ import annotations

import math
from pathlib import Path

from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.policies.mixin import SparsePolicyMixin

BEGIN = 0.8
CHECKPOINTS = 10


class BestCheckpoint(EvalCallback):
    """Saves the best of ten checkpoints in the last fifth of training as ``best_model.zip``.

    Only there, because before it masks still move, and only once pruning is done. (The last policy
    of DQN, dense or sparse, is often a bad moment of an oscillation; the RL zoo keeps its best one
    for the same reason.)

    :param eval_env: environments of the evaluation
    :param folder: where to save
    :param episodes: episodes of one evaluation
    """

    def __init__(self, eval_env: VecEnv, folder: Path, episodes: int = 10) -> None:
        super().__init__(
            eval_env,
            n_eval_episodes=episodes,
            best_model_save_path=str(folder),
            deterministic=True,
            verbose=0,
        )
        self.path = folder / "best_model.zip"

    def _on_training_start(self) -> None:
        self.planned = self.model._total_timesteps
        share = (1.0 - BEGIN) / CHECKPOINTS
        self.eval_freq = math.ceil(share * self.planned / self.model.n_envs)

    def _on_step(self) -> bool:
        # A rollout may go on beyond the planned steps.
        if not BEGIN * self.planned < self.num_timesteps <= self.planned or self._still_denser():
            return True
        return super()._on_step()

    def _still_denser(self) -> bool:
        policy = self.model.policy
        return isinstance(policy, SparsePolicyMixin) and any(
            network.denser for network in policy.sparse.networks
        )
