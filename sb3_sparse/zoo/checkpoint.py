"""Keeping the best policy of a run."""

from __future__ import annotations

from pathlib import Path

from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv

BEGIN = 0.8
CHECKPOINTS = 10


class BestCheckpoint(EvalCallback):
    """Saves the best of ten checkpoints in the last fifth of training as ``best_model.zip``.

    Only there, because before it masks still move and a policy that is being pruned is still denser
    than it shall be. (The last policy of DQN, dense or sparse, is often a bad moment of an
    oscillation; the RL zoo keeps its best one for the same reason.)

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
        self.eval_freq = max(1, int(share * self.planned / self.model.n_envs))

    def _on_step(self) -> bool:
        if self.num_timesteps <= BEGIN * self.planned:
            return True
        return super()._on_step()
