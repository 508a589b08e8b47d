"""rl_zoo3's ExperimentManager with the settings and callbacks of this package."""

from __future__ import annotations

import io
from argparse import Namespace
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.errors import MissingExtra, warn
from sb3_sparse.policies.saving import load_without_buffer
from sb3_sparse.zoo.buffers import import_buffers
from sb3_sparse.zoo.environments import mujoco_warns_once
from sb3_sparse.zoo.folder import REPLAY_BUFFER, RunFolder, Start
from sb3_sparse.zoo.replay import end_episodes, restore_buffer
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec, algorithms
from sb3_sparse.zoo.wrappers import with_env_wrappers

try:
    from rl_zoo3.callbacks import SaveVecNormalizeCallback
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.utils import ALGOS
except ImportError as error:
    raise MissingExtra("training runs", "zoo") from error


ANEW = Start()


class RunManager(ExperimentManager):
    """Makes environments, model and files as ``rl_zoo3.train`` does, for given settings.

    :param run: what to train
    :param settings: the settings to train it with
    :param folder: the run's folder
    :param evaluation: ``eval_freq`` and ``eval_episodes``
    :param start: the point from which to start or resume
    :param tensorboard_log: folder for TensorBoard; empty: none
    """

    def __init__(
        self,
        run: RunSpec,
        settings: Settings,
        folder: RunFolder,
        evaluation: Mapping[str, int],
        start: Start = ANEW,
        tensorboard_log: str = "",
    ) -> None:
        self.settings = settings
        self.evaluation = evaluation
        self.folder = folder
        self.start = start
        log_folder = str(folder.path.parent.parent)
        arguments = {
            **run.as_dict(),
            **evaluation,
            "env": run.env_id,
            "env_kwargs": None,
            "log_folder": log_folder,
            "tensorboard_log": tensorboard_log,
        }
        super().__init__(
            Namespace(**arguments),
            run.algo,
            run.env_id,
            log_folder,
            tensorboard_log,
            eval_freq=-1,  # training.py has its own evaluation and checkpoints
            save_freq=-1,
            n_eval_episodes=evaluation["eval_episodes"],
            seed=run.seed + start.steps,  # so that a resumed run does not repeat its beginning
            verbose=0,
            device=run.device,
            config=str(run.config),
        )
        self.save_path = str(folder)
        self.params_path = str(folder.parameters(run.env_id))
        if start.folder is not None:
            self.trained_agent = str(start.folder / f"{self.env_name}.zip")
            self.continue_training = True

    def read_hyperparameters(self) -> tuple[dict[str, Any], OrderedDict[str, Any]]:
        """The settings, instead of the YAML file that they came from."""
        hyperparams = with_env_wrappers(self.settings.as_dict())
        import_buffers(hyperparams)  # rl-zoo evaluates their names
        return hyperparams, OrderedDict(sorted(self.settings.as_dict().items()))

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """Make environments as rl-zoo does, without overwriting the episodes of a trained run.

        Evaluation gets the environment arguments in the settings too; rl-zoo gives them to training
        alone.
        """
        self.eval_env_kwargs = self.env_kwargs
        with mujoco_warns_once(self.env_name.gym_id):
            envs: VecEnv = super().create_envs(n_envs, eval_env, no_log or self.start.trained)
        return envs

    def setup(self) -> BaseAlgorithm:
        """Make the model, or load it from the checkpoint, with its environment.

        The steps are those of rl-zoo's ``setup_experiment``, which supports stock algorithms only.
        """
        with quiet():
            hyperparams, saved = self.read_hyperparameters()
            hyperparams, self.env_wrapper, self.callbacks, self.vec_env_wrapper = (
                self._preprocess_hyperparams(hyperparams)
            )
            self.create_log_folder()  # type: ignore[no-untyped-call]
            self.create_callbacks()  # type: ignore[no-untyped-call]
            env = self.create_envs(self.n_envs)
            hyperparams = self._preprocess_action_noise(hyperparams, saved, env)
            model = self._make(hyperparams, env)
            self._save_config(saved)
        resumes = self.start.folder is not None and not self.start.trained
        if isinstance(model, OffPolicyAlgorithm) and resumes:
            self._restore_buffer(model)
        return model

    def _make(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        algorithm: Any = algorithms()[self.algo]
        kwargs = {
            **hyperparams,
            "env": env,
            "tensorboard_log": self.tensorboard_log,
            "seed": self.seed,
            "verbose": self.verbose,
            "device": self.device,
        }
        if self.continue_training:
            for name in ("policy", "policy_kwargs"):  # the file holds them
                kwargs.pop(name, None)
            model: BaseAlgorithm = algorithm.load(self.trained_agent, **kwargs)
        else:
            model = algorithm(**kwargs)
        return model

    def _restore_buffer(self, model: OffPolicyAlgorithm) -> None:
        assert self.start.folder is not None
        folder = self.start.folder / REPLAY_BUFFER
        if not folder.is_dir():
            warn(
                f"there is no replay buffer in {folder}: the run continues with an empty one, and "
                "so differs from an uninterrupted run"
            )
            self.folder.write(without_buffer_from=model.num_timesteps)
            return
        assert model.replay_buffer is not None
        restore_buffer(model.replay_buffer, folder)
        end_episodes(model.replay_buffer)

    def save(self, model: BaseAlgorithm) -> Path:
        """Save the model as rl-zoo does, and return its file."""
        with quiet():
            self.save_trained_model(model)
        return Path(self.save_path) / f"{self.env_name}.zip"

    def evaluation_envs(self, count: int, seed: int) -> VecEnv:
        """Make separate environments for evaluation, with training's normalisation."""
        with quiet():
            envs: VecEnv = self.create_envs(count, eval_env=True)
        envs.seed(seed)
        return envs

    def keep_normalization(self) -> BaseCallback:
        """Return a callback that saves the normalisation with each new best model."""
        callback: BaseCallback = SaveVecNormalizeCallback(save_freq=1, save_path=self.params_path)
        return callback


@contextmanager
def quiet() -> Iterator[None]:
    """Hide what rl_zoo3 prints; its errors say more."""
    with redirect_stdout(io.StringIO()):
        yield


def spaces_of(
    run: RunSpec, settings: Settings, folder: RunFolder, evaluation: Mapping[str, int]
) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    """Return the policy's observation and action spaces, wrappers and stacking included."""
    experiment = RunManager(run, settings, folder, evaluation)
    with quiet():
        hyperparams, _ = experiment.read_hyperparameters()
        _, experiment.env_wrapper, _, experiment.vec_env_wrapper = (
            experiment._preprocess_hyperparams(hyperparams)
        )
        envs = experiment.create_envs(1, no_log=True)
    envs.close()
    return envs.observation_space, envs.action_space


def loadable_algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Return all algorithms that can be loaded, including those without a sparse policy."""
    return {**ALGOS, **algorithms()}


def load_for_prediction(algo: str, path: Path) -> BaseAlgorithm:
    """Load a saved model without its replay buffer."""
    return load_without_buffer(loadable_algorithms()[algo], path)
