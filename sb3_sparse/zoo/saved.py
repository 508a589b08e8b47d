"""A model on disk, and what is known of where it was trained."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.zips import check_state, look_into, read_model
from sb3_sparse.policies.internals import COUNTERS, LAST_SEEN, wrapped
from sb3_sparse.policies.registry import writers_of
from sb3_sparse.policies.saving import differ
from sb3_sparse.zoo.arguments import Kind, is_whole, kind_of
from sb3_sparse.zoo.environments import import_packages, package_names
from sb3_sparse.zoo.folder import (
    ARGUMENTS,
    CONFIG,
    VECNORMALIZE,
    arguments_of,
    environment_in,
    environment_settings,
    is_run,
    model_in,
    params_of,
    zip_path,
)
from sb3_sparse.zoo.manager import load_for_prediction, loadable_algorithms, quiet
from sb3_sparse.zoo.spec import algorithms

COUNTED = ("num_timesteps", *COUNTERS)
WHOLE = Kind("a whole number, 0 or more", lambda v: is_whole(v) and v >= 0)


@dataclass(frozen=True)
class Saved:
    """A saved model.

    :param path: the zip
    :param algo: algorithm, e.g. ``"sac"``
    :param env_id: what it was trained in; None: not known
    :param params: folder of its run's ``config.yml`` and normalisation; None: it lies in no run
    :param vecnormalize: statistics that its observations were normalised by; None: they were not
    :param settings: how its environments were made, by the names of
        :data:`~sb3_sparse.zoo.folder.OF_ENVIRONMENT`; empty if it lies in no run
    :param gym_packages: modules that register its environment or algorithm
    """

    path: Path
    algo: str
    env_id: str | None = None
    params: Path | None = None
    vecnormalize: Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    gym_packages: tuple[str, ...] = ()

    def load(self, env: VecEnv | None = None) -> BaseAlgorithm:
        """The model; without an environment it is fit for prediction only.

        Unpickles what SB3 pickled: the file must come from somebody who is trusted.

        :param env: to go on training in
        :raises ConfigError: if there is no such file, or it does not suit ``env``
        :raises CorruptStateError: if the file is damaged or of another algorithm, or if masks and
            weights in it disagree
        :raises Diverged: if its network is not finite
        """
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

    def check_suits(self, env: VecEnv, observations: Any, actions: Any) -> None:
        """Refuse an environment that shows or takes something else than the model knows.

        :param observations: the model's space of them
        :param actions: the model's space of them
        :raises ConfigError: if so
        """
        try:
            with quiet():
                seen = wrapped(env)
            check_for_correct_spaces(seen, observations, actions)
        except (ValueError, AssertionError) as error:
            raise ConfigError(
                f"{self.path} does not suit {self.env_id}: {error}; give the environment that it "
                "was trained in, and a run's folder where it wraps or stacks observations"
            ) from error


def check_attributes(path: Path, algo: str, data: Mapping[str, Any]) -> None:
    """Refuse a model with a setting that it cannot train on with.

    :param path: of its zip
    :param algo: algorithm, e.g. ``"sac"``
    :param data: the model's attributes; those that are no plain values are not looked at
    :raises CorruptStateError: if so
    """
    for name, value in data.items():
        kind = WHOLE if name in COUNTED else kind_of(algo, name)
        plain = value is None or isinstance(value, (bool, int, float, str, list, dict))
        if kind is not None and plain and not kind.fits(value):
            raise CorruptStateError(
                f"{path} cannot be trained on with: {name} must be {kind.allowed}, got {value!r}. "
                "Load it, set that, and save it again; or take an earlier one"
            )
    episodes = {type(data.get(name)) for name in ("ep_info_buffer", "ep_success_buffer")}
    if episodes not in ({deque}, {type(None)}):
        raise CorruptStateError(
            f"{path} is damaged: a buffer of episodes is missing or of another type; take an "
            "earlier one"
        )


def find_saved(
    path: Path,
    *,
    best: bool = False,
    algo: str | None = None,
    env_id: str | None = None,
    vecnormalize: Path | None = None,
    gym_packages: Sequence[str] = (),
) -> Saved:
    """Find a model and all that belongs to it.

    :param path: a run's folder, of ``sb3-sparse train`` or of ``rl_zoo3.train``, or a zip of SB3,
        in such a folder or not
    :param best: of a folder, the best policy instead of the last
    :param algo: None: as the run's folder or the file says
    :param env_id: None: as the run's folder says
    :param vecnormalize: statistics of a VecNormalize; None: those in the run's folder
    :param gym_packages: modules that register environments or algorithms, beside those that the run
        names
    :raises ConfigError: if there is no model, or what belongs to it is missing
    :raises CorruptStateError: if one of the files is damaged
    """
    if not is_run(path):
        path = zip_path(path)
    folder = path if path.is_dir() else path.parent
    arguments = arguments_of(folder) if path.is_dir() or is_run(folder) else {}
    env_id, packages = environment_in({**arguments, "env": env_id or arguments.get("env")})
    packages = package_names([*packages, *gym_packages])
    wanted = algo or arguments.get("algo")
    if wanted is not None and wanted not in loadable_algorithms():
        import_packages(packages)
    params = params_of(folder, arguments["env"]) if arguments else None
    if path.is_dir():
        path = model_in(folder, arguments["env"], best)
    if params is not None and arguments["algo"] not in loadable_algorithms():
        raise CorruptStateError(
            f"{params / ARGUMENTS} is damaged: algo is {arguments['algo']!r}; known are "
            f"{', '.join(loadable_algorithms())}"
        )
    algo = _algo(path, algo, arguments.get("algo"))
    settings: Mapping[str, Any] = {}
    if params is not None and (vecnormalize is None or (params / CONFIG).is_file()):
        settings = environment_settings(params)
    if vecnormalize is None:
        vecnormalize = _statistics_of_run(params, settings) if params else None
    if vecnormalize is None and params is None:
        _check_lone(path, algo)
    if vecnormalize is not None and not vecnormalize.is_file():
        raise ConfigError(
            f"there is no file {vecnormalize}; give what VecNormalize.save wrote, e.g. "
            f"{VECNORMALIZE}"
        )
    return Saved(path, algo, env_id, params, vecnormalize, settings, packages)


def _statistics_of_run(params: Path, settings: Mapping[str, Any]) -> Path | None:
    """The statistics in a run's folder; None if it was not normalised.

    :raises ConfigError: if they are not there though it was, or there though it was not
    """
    path = params / VECNORMALIZE
    if settings["normalize"] and not path.is_file():
        raise ConfigError(
            f"the run in {params.parent} normalised its observations, but {path} is missing; "
            "give the statistics with --vecnormalize FILE"
        )
    if path.is_file() and not settings["normalize"]:
        raise ConfigError(
            f"{path} is there, though {params / CONFIG} says that nothing was normalised; give "
            f"--vecnormalize {path} to use it, or remove it"
        )
    return path if settings["normalize"] else None


def _check_lone(path: Path, algo: str) -> None:
    """Refuse a zip outside a run that was, or may have been, normalised.

    :raises ConfigError: if so
    """
    for beside in (path.with_name(VECNORMALIZE), path.with_suffix("") / VECNORMALIZE):
        if beside.is_file():
            raise ConfigError(
                f"{beside} lies beside {path}: give --vecnormalize {beside} if the observations of "
                "this model were normalised by it, else move it elsewhere"
            )
    if issubclass(algorithms()[algo], OnPolicyAlgorithm):
        data, _ = read_model(path)
        if differ(*map(data.get, LAST_SEEN[:2])):
            raise ConfigError(
                f"{path} was trained under a VecNormalize; give its statistics with --vecnormalize "
                "FILE, also if it normalised rewards alone"
            )


def _algo(path: Path, given: str | None, known: str | None) -> str:
    """The algorithm to load a zip by.

    :raises ConfigError: if the one given is none, or not the file's
    """
    if given is None:
        return known or algos_of(path)[0]
    if given not in algorithms():
        raise ConfigError(f"unknown algorithm {given!r}; allowed are {', '.join(algorithms())}")
    told = algos_of(path)
    if given not in told:
        raise ConfigError(f"{path} is a model of {told[0]}, not of {given}; leave --algo out")
    return given


def algos_of(path: Path) -> list[str]:
    """The algorithms that may have saved a zip, told by its policy and attributes.

    There are several where they share a policy class, as TD3 and DDPG do; the first is the
    likeliest.

    :raises ConfigError: if it is no model, or of an algorithm that is not supported
    """
    data, _ = read_model(path)
    policy = data.get("policy_class")
    found = writers_of(policy, data) if isinstance(policy, type) else []
    if not found:
        named = policy.__name__ if isinstance(policy, type) else repr(policy)
        raise ConfigError(
            f"{path} has the policy {named}, which belongs to no supported algorithm; allowed are "
            f"{', '.join(algorithms())}"
        )
    return [name.lower() for name in found]
