"""A model on disk, and what is known of where it was trained."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.policies.saving import differ
from sb3_sparse.zoo.environments import package_names, plain_id
from sb3_sparse.zoo.experiment import load_for_prediction, saved_settings
from sb3_sparse.zoo.run import algorithms

VECNORMALIZE = "vecnormalize.pkl"
BY_POLICY = {
    "DQNPolicy": "dqn",
    "QRDQNPolicy": "qrdqn",
    "SACPolicy": "sac",
    "TQCPolicy": "tqc",
    "CrossQPolicy": "crossq",
    "TD3Policy": "td3",
}
"""Of the algorithms that have a policy class to themselves; DDPG is a TD3."""
FOREIGN = ("Recurrent", "Maskable")
"""Policies that inherit from PPO's and are of other algorithms."""
ON_POLICY = ("ppo", "a2c", "trpo")


@dataclass(frozen=True)
class Saved:
    """A saved model.

    :param path: the zip
    :param algo: algorithm, e.g. ``"sac"``
    :param env_id: what it was trained in; None: not known
    :param params: folder of its run's ``config.yml`` and normalisation; None: it lies in no run
    :param vecnormalize: statistics that its observations were normalised by; None: they were not
    :param gym_packages: modules that register its environment
    """

    path: Path
    algo: str
    env_id: str | None = None
    params: Path | None = None
    vecnormalize: Path | None = None
    gym_packages: tuple[str, ...] = ()

    def load(self, env: VecEnv | None = None) -> BaseAlgorithm:
        """The model; without an environment it is fit for prediction only.

        :param env: to go on training in
        :raises ConfigError: if the file is of another algorithm, or does not suit ``env``
        :raises CorruptStateError: if masks and weights in the file disagree
        """
        check_masks(self.path)
        try:
            if env is None:
                return load_for_prediction(self.algo, self.path)
            model: BaseAlgorithm = algorithms()[self.algo].load(self.path, env=env)
            return model
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(
                f"{self.path} cannot be loaded as a model of {self.algo}: {error}"
            ) from error


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
    :param gym_packages: modules that register environments, beside those that the run names
    :raises ConfigError: if there is no model, or its statistics are missing
    """
    if not is_run(path):
        path = zip_path(path)
    folder = path if path.is_dir() else path.parent
    arguments = arguments_of(folder) if path.is_dir() or is_run(folder) else {}
    env_id, packages = environment_in({**arguments, "env": env_id or arguments.get("env")})
    packages = package_names([*packages, *gym_packages])
    params = _params_of(folder, arguments["env"]) if arguments else None
    if path.is_dir():
        path = model_in(folder, arguments["env"], best)
    if vecnormalize is None and params is not None and saved_settings(params).get("normalize"):
        vecnormalize = params / VECNORMALIZE
        if not vecnormalize.is_file():
            raise ConfigError(
                f"the run in {folder} normalised its observations, but {vecnormalize} is missing; "
                "give the statistics with --vecnormalize FILE"
            )
    algo = _algo(path, algo, arguments.get("algo"))
    if vecnormalize is None and params is None and algo in ON_POLICY:
        data, _ = read_zip(path)
        if differ(data.get("_last_obs"), data.get("_last_original_obs")):
            raise ConfigError(
                f"{path} was trained under a VecNormalize; give its statistics with --vecnormalize "
                "FILE, also if it normalised rewards alone"
            )
    if vecnormalize is not None and not vecnormalize.is_file():
        raise ConfigError(
            f"there is no file {vecnormalize}; give what VecNormalize.save wrote, e.g. "
            f"{VECNORMALIZE}"
        )
    return Saved(path, algo, env_id, params, vecnormalize, packages)


def _algo(path: Path, given: str | None, known: str | None) -> str:
    """The algorithm to load a zip by.

    :raises ConfigError: if the one given is none, or not the file's
    """
    if given is None:
        return known or algo_of(path)
    if given not in algorithms():
        raise ConfigError(f"unknown algorithm {given!r}; allowed are {', '.join(algorithms())}")
    told = algo_of(path)
    if given != told and {given, told} != {"td3", "ddpg"}:
        raise ConfigError(f"{path} is a model of {told}, not of {given}; leave --algo out")
    return given


def algo_of(path: Path) -> str:
    """The algorithm that a zip was saved by, told by its policy and attributes.

    :raises ConfigError: if it is no model, or of an algorithm that is not supported
    """
    data, _ = read_zip(path)
    policy = data.get("policy_class")
    names = [cls.__name__ for cls in policy.__mro__] if isinstance(policy, type) else []
    foreign = any(name.startswith(FOREIGN) for name in names)
    for name, algo in BY_POLICY.items():
        if name in names:
            return algo
    if "ActorCriticPolicy" in names and not foreign:
        on_policy = {"clip_range": "ppo", "cg_max_steps": "trpo"}
        return next((algo for key, algo in on_policy.items() if key in data), "a2c")
    raise ConfigError(
        f"{path} has the policy {names[0] if names else policy!r}, which belongs to no supported "
        f"algorithm; allowed are {', '.join(algorithms())}"
    )


def read_zip(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What SB3 saved: data, and the policy's state_dict.

    :raises ConfigError: if there is no such file, or it is no model
    """
    if not path.is_file():
        raise ConfigError(f"there is no file {path}; give a model saved by SB3, e.g. model.zip")
    try:
        data, params, _ = load_from_zip_file(path, device="cpu")
    except (BadZipFile, ValueError) as error:
        raise ConfigError(f"{path} is no model saved by SB3: {error}") from error
    if data is None or "policy" not in params:
        raise ConfigError(f"{path} is damaged: it has no data or no policy in it")
    state: Any = params["policy"]
    return data, state


def zip_path(path: Path) -> Path:
    """The path with the suffix that SB3 adds, where it was left out."""
    if not path.name or path.suffix:
        return path
    with_suffix = path.with_suffix(".zip")
    return with_suffix if with_suffix.is_file() else path


def check_masks(path: Path) -> None:
    """Refuse a file with weights where its masks have none, which loading would set to 0.

    :raises CorruptStateError: if so
    """
    _, state = read_zip(path)
    for name, mask in state.items():
        if name.endswith("_mask") and name.removesuffix("_mask") in state:
            weight = state[name.removesuffix("_mask")]
            wrong = int((weight[~mask.bool()] != 0).sum())
            if wrong:
                raise CorruptStateError(
                    f"masks and weights disagree in {path}: {wrong} connections of "
                    f"{name.removesuffix('.weight_mask')} are not 0 though its mask has them "
                    "inactive; somebody changed the file. Take an earlier one, or load it with "
                    "<algorithm>.load, which sets them to 0, and save it again"
                )


def model_in(folder: Path, env_id: str, best: bool) -> Path:
    """The last or best policy in a run's folder.

    :raises ConfigError: if there is none
    """
    path = folder / ("best_model.zip" if best else f"{env_id.replace('/', '-')}.zip")
    if not path.is_file():
        models = ", ".join(sorted(file.name for file in folder.glob("*.zip"))) or "none"
        why = (
            "there is a best policy after the first evaluation at the sparsity asked for"
            if best
            else "a run that was killed has its last policy after sb3-sparse train --resume"
        )
        raise ConfigError(f"{folder} has no {path.name} (its models: {models}): {why}")
    return path


def arguments_of(folder: Path) -> dict[str, Any]:
    """What a run was started with, from the file that rl-zoo writes.

    :raises ConfigError: if there is no run
    """
    files = list(folder.glob("*/args.yml"))
    compression = folder / "compress.json"
    if not files and compression.is_file():
        if json.loads(compression.read_text()).get("finished"):
            raise ConfigError(f"{folder} is no run's folder; give the zip in it")
        raise ConfigError(
            f"the compression in {folder} is not finished; give its command again, and it goes on"
        )
    if len(files) != 1:
        raise ConfigError(
            f"there is no run in {folder}; give the run's own folder, e.g. "
            "logs/sac/HalfCheetah-v5_1"
        )
    # rl-zoo writes Python objects into it
    arguments = yaml.load(files[0].read_text(), Loader=yaml.UnsafeLoader)
    return dict(arguments)


def environment_in(arguments: Mapping[str, Any]) -> tuple[str | None, tuple[str, ...]]:
    """The environment's plain id in a run's arguments, and the modules that register it.

    :param arguments: as :func:`arguments_of` returns them
    """
    packages = package_names(arguments.get("gym_packages"))
    env_id = arguments.get("env")
    return (None, packages) if env_id is None else plain_id(str(env_id), packages)


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run."""
    return len(list(folder.glob("*/args.yml"))) == 1


def _params_of(folder: Path, env_id: str) -> Path:
    return folder / env_id.replace("/", "-")
