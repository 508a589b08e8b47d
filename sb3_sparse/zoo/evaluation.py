"""Evaluation while training: SB3's, but on time after a resume and with no best that is dense."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.policies.mixin import SparsePolicyMixin

NPZ = "evaluations.npz"


class Evaluation(EvalCallback):
    """SB3's EvalCallback at fixed environment steps; goes on where an interrupted run was.

    ``best_model.zip`` is the best policy of the sparsity asked for: while pruning is under way,
    policies are evaluated and logged but not kept.

    :param eval_env: environments of the evaluation
    :param folder: where ``evaluations.npz`` and ``best_model.zip`` go
    :param every: environment steps between two evaluations
    :param episodes: episodes of one evaluation
    :param deterministic: whether the policy acts deterministically
    :param on_new_best: called when there is a new best model
    """

    def __init__(
        self,
        eval_env: VecEnv,
        folder: Path,
        every: int,
        episodes: int,
        deterministic: bool,
        on_new_best: BaseCallback,
    ) -> None:
        super().__init__(
            eval_env,
            callback_on_new_best=on_new_best,
            n_eval_episodes=episodes,
            eval_freq=1,  # whenever _on_step below lets it
            log_path=str(folder),
            best_model_save_path=str(folder),
            deterministic=deterministic,
            verbose=0,
        )
        self.folder = folder
        self.every = every

    @property
    def count(self) -> int:
        """Evaluations done."""
        return len(self.evaluations_timesteps)

    def state(self) -> dict[str, Any]:
        """What :meth:`restore` needs besides ``evaluations.npz``."""
        return {"best_mean_reward": self.best_mean_reward, "count": self.count}

    def restore(self, state: dict[str, Any], npz: Path) -> None:
        """Take back the evaluations of an interrupted run."""
        self.best_mean_reward = state["best_mean_reward"]
        if state["count"] == 0:
            return
        with np.load(npz) as saved:
            self.evaluations_timesteps = saved["timesteps"].tolist()
            self.evaluations_results = saved["results"].tolist()
            self.evaluations_length = saved["ep_lengths"].tolist()
            if "successes" in saved:
                self.evaluations_successes = saved["successes"].tolist()

    def _on_training_start(self) -> None:
        self.next = (self.model.num_timesteps // self.every + 1) * self.every

    def _on_step(self) -> bool:
        if self.num_timesteps < self.next:
            return True
        self.next = (self.num_timesteps // self.every + 1) * self.every
        policy = self.model.policy
        assert isinstance(policy, SparsePolicyMixin)
        if not any(network.denser for network in policy.sparse.networks):
            return super()._on_step()
        kept, self.best_model_save_path = self.best_model_save_path, None
        go_on = super()._on_step()
        self.best_model_save_path = kept
        self.best_mean_reward = -np.inf
        return go_on
