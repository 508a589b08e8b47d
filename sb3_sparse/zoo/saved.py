"""Loads a saved model, and makes the environments that it was trained in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_sparse.errors import ConfigError, CorruptStateError, MissingExtra, SparsityError
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.sbx import is_sbx, load_sbx
from sb3_sparse.loading.text import read_text
from sb3_sparse.loading.zips import check_state, look_into, read_model
from sb3_sparse.loading.zooyaml import NotBuilt
from sb3_sparse.policies.compiled import unwrapped
from sb3_sparse.policies.internals import wrapped
from sb3_sparse.sparsity.numeric import is_whole
from sb3_sparse.zoo.attributes import check_attributes
from sb3_sparse.zoo.environments import (
    import_packages,
    is_atari,
    known_environment,
    mujoco_warns_once,
    package_names,
)
from sb3_sparse.zoo.folder import RunFolder, locate
from sb3_sparse.zoo.manager import load_for_prediction, loadable_algorithms, quiet
from sb3_sparse.zoo.normalization import normalized, statistics_of
from sb3_sparse.zoo.prepare import setup_errors
from sb3_sparse.zoo.run_files import (
    ARGUMENTS,
    CONFIG,
    RESTORE,
    environment_in,
    environment_settings,
)
from sb3_sparse.zoo.saved_by import algo_of
from sb3_sparse.zoo.spec import algorithms
from sb3_sparse.zoo.wrappers import check_wrappers, with_env_wrappers

try:
    from rl_zoo3.utils import create_test_env
except ImportError as error:
    raise MissingExtra("the environments of a saved model", "zoo") from error

EVALUATION_ENVS = 10


@dataclass(frozen=True)
class SavedModel:
    """A saved model with its training environment. :meth:`find` makes one.

    Example::

        from sb3_sparse.zoo import RunSpec, SavedModel, train

        outcome = train(RunSpec(n_timesteps=200, eval_freq=100, eval_episodes=1))
        saved = SavedModel.find(outcome.folder, best=True)
        model, envs = saved.load(), saved.evaluation_envs(episodes=5, seed=0)
        print(saved.algo, saved.env_id, model.predict(envs.reset()))

    :param path: the zip
    :param algo: algorithm, e.g. ``"sac"``
    :param env_id: environment that it was trained in; None: unknown
    :param parameters: folder of its run's ``config.yml`` and normalisation; None: it has no run
    :param vecnormalize: statistics that normalised its observations; None: nothing did
    :param settings: how its environments were made, by the names of
        :data:`~sb3_sparse.zoo.run_files.OF_ENVIRONMENT`; empty if it has no run
    :param gym_packages: modules that register its environment or algorithm
    """

    path: Path
    algo: str
    env_id: str | None = None
    parameters: Path | None = None
    vecnormalize: Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    gym_packages: tuple[str, ...] = ()

    @classmethod
    def find(
        cls,
        path: Path | str,
        *,
        best: bool = False,
        algo: str | None = None,
        env_id: str | None = None,
        vecnormalize: Path | None = None,
        gym_packages: Sequence[str] = (),
    ) -> SavedModel:
        """Find a model and the files that belong to it.

        :param path: a run's folder, of ``sb3-sparse train`` or ``rl_zoo3.train``, or a zip of SB3,
            in such a folder or not
        :param best: take a folder's best policy instead of its last
        :param algo: algorithm; None: the one that the run's folder or the file names
        :param env_id: environment; None: the one that the run's folder names
        :param vecnormalize: statistics of a VecNormalize; None: those in the run's folder
        :param gym_packages: further modules that register environments or algorithms
        :raises ConfigError: if the model, or a file that belongs to it, is missing
        :raises CorruptStateError: if one of the files is damaged
        """
        path, folder = locate(path, best)
        arguments = folder.arguments() if folder.is_run else {}
        env_id, packages = environment_in({**arguments, "env": env_id or arguments.get("env")})
        packages = package_names([*packages, *gym_packages])
        wanted = algo or arguments.get("algo")
        if wanted is not None and wanted not in loadable_algorithms():
            import_packages(packages)
        parameters = folder.parameters(arguments["env"]) if arguments else None
        if parameters is not None and arguments["algo"] not in loadable_algorithms():
            raise CorruptStateError(
                f"{parameters / ARGUMENTS} is damaged: algo is {arguments['algo']!r}; known are "
                f"{', '.join(loadable_algorithms())}"
            )
        algo = algo_of(path, algo, arguments.get("algo"))
        settings: Mapping[str, Any] = {}
        if parameters is not None and (vecnormalize is None or (parameters / CONFIG).is_file()):
            settings = environment_settings(parameters)
        vecnormalize = statistics_of(path, algo, vecnormalize, parameters, settings)
        return cls(path, algo, env_id, parameters, vecnormalize, settings, packages)

    def load(self, env: VecEnv | None = None) -> BaseAlgorithm:
        """Load the model; without an environment it can only predict.

        This unpickles what SB3 pickled, so load only files from people you trust.

        :param env: environment to continue training in
        :raises ConfigError: if there is no such file, or the model does not suit ``env``
        :raises CorruptStateError: if the file is damaged or of another algorithm, or if masks and
            weights in it disagree
        :raises Diverged: if a network is not finite
        :raises UnsupportedError: for a model of SBX, if it is to continue training
        :raises MissingExtra: for a model of SBX, if that is not installed
        """
        if env is None and is_sbx(self.path):
            return load_sbx(self.path, self.algo)
        check_state(look_into(self.path).state, str(self.path))
        if env is not None:
            data, _ = read_model(self.path)
            self.check_suits(env, data.get("observation_space"), data.get("action_space"))
            check_attributes(self.path, self.algo, data)
        with reading(
            self.path,
            f"model of {self.algo}",
            "give the --algo that it was trained with, or an earlier checkpoint",
        ):
            if env is None:
                return load_for_prediction(self.algo, self.path)
            model: BaseAlgorithm = algorithms()[self.algo].load(self.path, env=env)
            return model

    def policy(self) -> BasePolicy:
        """Load the policy alone, for prediction.

        :raises ConfigError: as :meth:`load`
        :raises CorruptStateError: as :meth:`load`
        :raises Diverged: as :meth:`load`
        """
        return unwrapped(self.load().policy)

    def check_suits(self, env: VecEnv, observations: Any, actions: Any) -> None:
        """Reject an environment whose spaces are not the model's.

        :param observations: the model's observation space
        :param actions: the model's action space
        :raises ConfigError: if they differ
        """
        try:
            with quiet():
                seen = wrapped(env)
            check_for_correct_spaces(seen, observations, actions)
        except (ValueError, AssertionError) as error:
            raise ConfigError(
                f"{self.path} does not suit {self.env_id}: {error}; give the environment that it "
                "was trained in, and the run's folder if that run wraps or stacks observations"
            ) from error

    @property
    def environment(self) -> str:
        """The environment's id; reading it registers the environment.

        :raises ConfigError: if the environment is unknown, or not registered
        """
        if self.env_id is None:
            raise ConfigError(
                f"{self.path} does not name its environment; give --env, e.g. --env CartPole-v1"
            )
        import_packages(self.gym_packages)
        known_environment(self.env_id)
        return self.env_id

    @property
    def acts_deterministically(self) -> bool:
        """Whether rl-zoo evaluates the model deterministically: yes, except in Atari games."""
        return not is_atari(self.environment)

    def envs(
        self,
        n_envs: int,
        seed: int,
        *,
        training: bool = False,
        wrappers: Sequence[Mapping[str, Any]] = (),
        env_kwargs: Mapping[str, Any] | None = None,
    ) -> VecEnv:
        """Make environments with the wrappers, stacking and normalisation of the training.

        :param n_envs: number of environments, all in this process
        :param training: whether rewards are normalised and statistics updated
        :param wrappers: further wrappers, around those of the run but below stacking and
            normalisation; each maps a path to its arguments, as in rl-zoo's ``env_wrapper``
        :param env_kwargs: further arguments of the environment
        :raises ConfigError: if the environment is unknown, not registered, or cannot be made
        :raises CorruptStateError: if a file that belongs to the model is damaged
        """
        env_id = self.environment
        settings = with_env_wrappers(self.settings, wrappers)
        kwargs = dict(settings.pop("env_kwargs", {}))
        where = ""
        if self.parameters is not None:
            kwargs |= RunFolder(self.parameters.parent).arguments().get("env_kwargs") or {}
            where = f" with the wrappers and arguments in {self.parameters}"
        kwargs |= env_kwargs or {}
        failure = f"{env_id} cannot be made{where}"
        with setup_errors(failure, env_id), quiet(), mujoco_warns_once(env_id):
            check_wrappers(settings)
            envs: VecEnv = create_test_env(
                env_id,
                n_envs=n_envs,
                seed=seed,
                should_render=False,
                hyperparams=settings,
                env_kwargs=kwargs,
                vec_env_cls=DummyVecEnv,
            )
        try:
            if self.vecnormalize is not None:
                envs = normalized(envs, self.vecnormalize, training)
            if settings.get("frame_stack"):
                with setup_errors(f"frames of {env_id} cannot be stacked", env_id):
                    envs = VecFrameStack(envs, settings["frame_stack"])
        except SparsityError:
            envs.close()
            raise
        return envs

    def training_envs(self, n_envs: int | None, seed: int) -> VecEnv:
        """Make environments to continue training in.

        :param n_envs: number of environments; None: as many as the model was trained in
        :raises ConfigError: as :meth:`envs`
        :raises CorruptStateError: as :meth:`envs`
        """
        if n_envs is None:
            n_envs = look_into(self.path).data.get("n_envs")
        if not 0 <= seed < 2**31:
            raise ConfigError(f"the seed must lie in [0, 2^31), got {seed}")
        if n_envs is None or not is_whole(n_envs) or n_envs < 1:
            raise ConfigError(f"n_envs must be 1 or more, got {n_envs!r}; give --n-envs")
        return self.envs(n_envs, seed, training=True)

    def evaluation_envs(self, episodes: int, seed: int) -> VecEnv:
        """Make environments with unnormalised rewards, whose statistics do not change.

        :param episodes: episodes of one evaluation
        :raises ConfigError: as :meth:`envs`
        :raises CorruptStateError: as :meth:`envs`
        """
        # An Atari episode is one life: of several environments, none might finish a game.
        atari = is_atari(self.environment)
        return self.envs(1 if atari else max(1, min(EVALUATION_ENVS, episodes)), seed)

    def write_run_files(self, folder: Path) -> None:
        """Write the files that make a folder a run for rl-zoo and ``sb3-sparse enjoy``.

        :param folder: the run's folder; its model will be ``<env>.zip``
        """
        env_id = self.environment
        parameters = RunFolder(folder).parameters(env_id)
        parameters.mkdir(parents=True, exist_ok=True)
        arguments: dict[str, Any] = {"env_kwargs": None, "seed": 0}
        normalize = self.vecnormalize is not None
        settings = yaml.dump({"normalize": normalize})
        if self.parameters is not None:
            known = RunFolder(self.parameters.parent).arguments()
            arguments = {key: one for key, one in known.items() if not isinstance(one, NotBuilt)}
            if self.settings:
                settings = read_text(self.parameters / CONFIG, "YAML file of a run", RESTORE)
                if self.settings["normalize"] != normalize:  # statistics were given for it
                    settings = yaml.dump({**self.settings, "normalize": normalize})
        arguments |= {"algo": self.algo, "env": env_id, "gym_packages": list(self.gym_packages)}
        (parameters / ARGUMENTS).write_text(yaml.dump(arguments), encoding="utf-8")
        (parameters / CONFIG).write_text(settings, encoding="utf-8")
