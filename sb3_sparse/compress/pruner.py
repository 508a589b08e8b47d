"""Prunes, fine-tunes, evaluates and saves models for a search."""

from __future__ import annotations

import copy
import shutil
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_sparse.analysis.evaluation import episode_returns
from sb3_sparse.compress.finetune import fill_buffer, fine_tune
from sb3_sparse.compress.twin import load_beside, sparse_policy, sparsify, sparsity_of
from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.errors import CorruptStateError
from sb3_sparse.files import written_whole
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.statistics import load_statistics
from sb3_sparse.policies.internals import LAST_SEEN

LEVELS = "levels"
VECNORMALIZE = "vecnormalize.pkl"
SEEDS_PER_BATCH = 1000
"""More than there are environments, each of which has its own seed."""
NORMALIZATION = ("obs_rms", "ret_rms")


class ModelPruner:
    """Prunes, fine-tunes and evaluates a model for a search.

    :param model: the original model, with an environment; it is not changed, but its environment
        and replay buffer are used
    :param eval_env: environments for evaluation
    :param folder: where accepted models are kept
    :param steps: environment steps of a fine-tuning
    :param episodes: episodes of a batch
    :param seed: seed of training and evaluation
    :param deterministic: whether policies are evaluated deterministically
    :param distribution: how sparsity is shared out among layers; None: as the model has it
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        eval_env: VecEnv,
        folder: Path,
        steps: int,
        episodes: int,
        seed: int,
        deterministic: bool,
        distribution: str | None,
    ) -> None:
        self.model = model
        self.eval_env = eval_env
        self.folder = folder
        self.steps = steps
        self.episodes = episodes
        self.seed = seed
        self.deterministic = deterministic
        self.sparsities = sparsity_of(model)
        self.network = "actor" if "actor" in self.sparsities else next(iter(self.sparsities))
        self.accepted = sparsify(model, self.sparsities, distribution=distribution)
        self.candidate = self.accepted
        self._played_last = model
        self._before = self._statistics()
        """Normalisation of the original model."""
        self._kept = self._before
        """Normalisation of the accepted model."""

    @property
    def nnz(self) -> int:
        """Number of connections of the accepted model's acting network."""
        return self._acting(self.accepted).nnz

    @property
    def floor(self) -> float:
        """Density at which every layer of the acting network has one connection."""
        network = self._acting(self.accepted)
        return len(network.layers) / network.size

    def restore(self, number: int) -> None:
        """Make the model of a level the accepted one.

        :raises CorruptStateError: if its file is missing
        """
        path = self._path(number)
        if not path.is_file():
            raise CorruptStateError(f"{path} is missing; remove {self.folder} and start again")
        with reading(path, "level of a compression", f"remove {self.folder} and start again"):
            self.candidate = self.accepted = load_beside(self.model, path)
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            saved = load_statistics(path.with_suffix(".pkl"), normalize.venv)
            self._kept = _statistics_of(saved)

    def make(self, number: int, sparsity: float) -> int:
        """Prune and fine-tune the accepted model; return the nnz of the acting network."""
        self._set_statistics(self.model.env, self._kept)
        if isinstance(self.accepted, OffPolicyAlgorithm):
            # The environment continues where the last model left it, as the buffer expects.
            for name in LAST_SEEN:
                setattr(self.accepted, name, copy.deepcopy(getattr(self._played_last, name)))
            self.accepted.set_random_seed(self.seed)
            fill_buffer(self.accepted)
        model = sparsify(self.accepted, {**self.sparsities, self.network: sparsity})
        model.set_random_seed(self.seed + number)
        if isinstance(model, OnPolicyAlgorithm):
            model._last_obs = None  # so that a level starts the same, whatever came before
        self._played_last = self.candidate = model
        fine_tune(model, self.steps)
        return self._acting(model).nnz

    def returns(self, baseline: bool, batch: int) -> list[float]:
        """Return the returns of a numbered batch of episodes, of the baseline or the candidate."""
        statistics = self._before if baseline else self._statistics()
        self._set_statistics(self.eval_env, statistics)
        return episode_returns(
            self.model if baseline else self.candidate,
            self.eval_env,
            self.episodes,
            self.seed + SEEDS_PER_BATCH * (batch + 1),
            self.deterministic,
        )

    def accept(self, number: int) -> None:
        """Accept the candidate, and save it to disk."""
        self.accepted, self._kept = self.candidate, self._statistics()
        path = self._path(number)
        path.parent.mkdir(exist_ok=True)
        self._save(path, path.with_suffix(".pkl"))

    def back_to_accepted(self) -> None:
        """Make the accepted model the candidate again, and restore its normalisation."""
        self.candidate = self.accepted
        self._set_statistics(self.model.env, self._kept)

    def forget_levels(self, kept: int) -> None:
        """Remove the files of all levels but one.

        :param kept: number of the level to keep; 0: keep none
        """
        for path in (self.folder / LEVELS).glob("*"):
            if path.stem != str(kept):
                path.unlink()

    def finish(self, name: str) -> Path:
        """Write the accepted model in the layout of an rl-zoo run; return its file."""
        self.back_to_accepted()
        (self.folder / name).mkdir(exist_ok=True)
        path = self.folder / f"{name}.zip"
        self._save(path, self.folder / name / VECNORMALIZE)
        return path

    def clear(self) -> None:
        """Remove the files that only an interrupted search needs."""
        shutil.rmtree(self.folder / LEVELS, ignore_errors=True)

    def _save(self, path: Path, normalization: Path) -> None:
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            normalize.save(str(normalization))
        with written_whole(path) as new, new.open("wb") as file:
            self.candidate.save(file)

    def _acting(self, model: BaseAlgorithm) -> SparseNetwork:
        networks = sparse_policy(model).sparse.networks
        return next(network for network in networks if network.name == self.network)

    def _path(self, number: int) -> Path:
        return self.folder / LEVELS / f"{number}.zip"

    def _statistics(self) -> dict[str, Any]:
        normalize = self.model.get_vec_normalize_env()
        return {} if normalize is None else _statistics_of(normalize)

    @staticmethod
    def _set_statistics(env: VecEnv | None, statistics: dict[str, Any]) -> None:
        normalize = None if env is None else unwrap_vec_normalize(env)
        if normalize is not None:
            vars(normalize).update(copy.deepcopy(statistics))


def _statistics_of(normalize: VecNormalize) -> dict[str, Any]:
    """Copy the statistics of a VecNormalize, which has no obs_rms without norm_obs."""
    return {
        name: copy.deepcopy(found)
        for name, found in vars(normalize).items()
        if name in NORMALIZATION
    }
