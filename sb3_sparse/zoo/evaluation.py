"""EvalCallback that stays on schedule after a resume and never keeps a too-dense best model."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import ZipFile

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.files import written_whole
from sb3_sparse.loading.arrays import read_arrays
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.text import read_json
from sb3_sparse.loading.zips import read_model
from sb3_sparse.policies.base import BaseSparsePolicy
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.zoo.clock import Clock
from sb3_sparse.zoo.divergence import check_networks, check_return
from sb3_sparse.zoo.folder import BEST, EVALUATIONS
from sb3_sparse.zoo.watch import Watch

STATE = "evaluation.json"
UNFINISHED = "unfinished"
CURE = (
    "nothing was changed. Restore it from a copy, or train anew: the run keeps its best model and "
    "evaluations"
)


@dataclass(frozen=True)
class Evaluated:
    """The evaluations in a checkpoint.

    :param best_mean_reward: mean return of the best model
    :param timesteps: environment steps before each evaluation
    :param results: episode returns of each evaluation
    :param lengths: episode lengths in steps
    :param successes: whether each episode succeeded, where the environment reports it
    """

    best_mean_reward: float
    timesteps: list[int] = field(default_factory=list)
    results: list[list[float]] = field(default_factory=list)
    lengths: list[list[int]] = field(default_factory=list)
    successes: list[list[bool]] = field(default_factory=list)

    @classmethod
    def read(cls, folder: Path) -> Evaluated:
        """Read a checkpoint's evaluations, and check that its best model is intact.

        :raises ConfigError: if a file is missing
        :raises CorruptStateError: if a file is damaged
        """
        what, path = "file of a checkpoint", folder / STATE
        state = read_json(path, what, CURE)
        with reading(path, what, CURE):
            best, count = float(state["best_mean_reward"]), int(state["count"])
        path = folder / BEST
        if path.is_file():
            with reading(path, what, CURE), ZipFile(path) as file:
                damaged = file.testzip()
            if damaged is not None:
                raise CorruptStateError(f"{path} is damaged: the checksum of {damaged}; {CURE}")
            read_model(path)
        if count == 0:
            return cls(best)
        needed, path = ("timesteps", "results", "ep_lengths"), folder / EVALUATIONS
        saved = read_arrays(path, what, CURE, needed)
        steps, *episodes = (saved[name].shape for name in needed)
        if steps != (count,) or any(one[:1] != steps or len(one) != 2 for one in episodes):
            raise CorruptStateError(f"{path} is damaged: it lacks {count} evaluations; {CURE}")
        names = (*needed, "successes")
        return cls(best, *(saved[name].tolist() for name in names if name in saved))


class Evaluation(EvalCallback):
    """SB3's EvalCallback at fixed environment steps, which continues after an interruption.

    Networks that hold NaN are not evaluated: training ends with
    :class:`~sb3_sparse.errors.Diverged`.

    ``best_model.zip`` is the best policy at the requested sparsity: during pruning, policies
    are evaluated and logged but not kept.

    :param eval_env: environments to evaluate in
    :param folder: folder of ``evaluations.npz`` and ``best_model.zip``
    :param every: environment steps between two evaluations
    :param episodes: episodes of one evaluation
    :param deterministic: whether the policy acts deterministically
    :param on_new_best: called after each new best model
    :param watch: notified of each evaluation
    :param clock: paused during each evaluation
    :param after_each: called after each evaluation
    """

    def __init__(
        self,
        eval_env: VecEnv,
        folder: Path,
        every: int,
        episodes: int,
        deterministic: bool,
        on_new_best: BaseCallback,
        watch: Watch,
        clock: Clock,
        after_each: BaseCallback | None = None,
    ) -> None:
        super().__init__(
            eval_env,
            callback_on_new_best=on_new_best,
            callback_after_eval=after_each,
            n_eval_episodes=episodes,
            eval_freq=1,  # _on_step below decides when
            log_path=str(folder / UNFINISHED),
            best_model_save_path=str(folder / UNFINISHED),
            deterministic=deterministic,
            verbose=0,
        )
        self.folder = folder
        self.every = every
        self.watch = watch
        self.clock = clock

    @property
    def count(self) -> int:
        """Number of evaluations so far."""
        return len(self.evaluations_timesteps)

    def save(self, folder: Path) -> None:
        """Save the evaluations so far and the best model."""
        state = {"best_mean_reward": self.best_mean_reward, "count": self.count}
        (folder / STATE).write_text(json.dumps(state))
        for name in (EVALUATIONS, BEST):
            if (self.folder / name).is_file():
                shutil.copy(self.folder / name, folder / name)

    def forget(self) -> None:
        """Remove the earlier evaluations of a run that starts anew."""
        for name in (EVALUATIONS, BEST):
            (self.folder / name).unlink(missing_ok=True)

    def restore(self, folder: Path) -> None:
        """Restore what :meth:`save` saved, and drop all later evaluations.

        :raises CorruptStateError: if a file is damaged; nothing is changed then
        """
        saved = Evaluated.read(folder)
        for name in (EVALUATIONS, BEST):
            if (folder / name).is_file():
                with written_whole(self.folder / name) as new:
                    shutil.copy(folder / name, new)
            else:
                (self.folder / name).unlink(missing_ok=True)
        self.best_mean_reward = saved.best_mean_reward
        self.evaluations_timesteps = saved.timesteps
        self.evaluations_results = saved.results
        self.evaluations_length = saved.lengths
        self.evaluations_successes = saved.successes

    def _init_callback(self) -> None:
        super()._init_callback()  # makes the folder, if a kill has not left one with files
        shutil.rmtree(self.folder / UNFINISHED)

    def _on_training_start(self) -> None:
        self.next = (self.model.num_timesteps // self.every + 1) * self.every

    def _on_step(self) -> bool:
        if self.num_timesteps < self.next:
            return True
        self.next = (self.num_timesteps // self.every + 1) * self.every
        with self.clock.paused():
            return self._evaluate_and_tell()

    def _evaluate_and_tell(self) -> bool:
        check_networks(self.model)
        with self._whole_files():
            go_on = self._evaluate()
        check_return(self.last_mean_reward, self.num_timesteps)
        best = self.best_mean_reward if np.isfinite(self.best_mean_reward) else None
        std = float(np.std(self.evaluations_results[-1]))
        self.watch.evaluated(self.num_timesteps, self.last_mean_reward, std, best)
        return go_on

    def _evaluate(self) -> bool:
        policy = unwrapped(self.model.policy)
        assert isinstance(policy, BaseSparsePolicy)
        if not any(network.denser for network in policy.sparse.networks):
            return super()._on_step()
        kept, self.best_model_save_path = self.best_model_save_path, None
        go_on = super()._on_step()
        self.best_model_save_path = kept
        self.best_mean_reward = -np.inf
        return go_on

    @contextmanager
    def _whole_files(self) -> Iterator[None]:
        """Replace best model and evaluations only by complete files, even if the disk fills up."""
        new = self.folder / UNFINISHED
        new.mkdir(exist_ok=True)
        try:
            yield
            for path in new.iterdir():
                path.replace(self.folder / path.name)
        finally:
            shutil.rmtree(new, ignore_errors=True)
