"""The statistics that normalised the observations of a saved model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_sparse.errors import ConfigError
from sb3_sparse.loading.sbx import is_sbx, read_attributes
from sb3_sparse.loading.statistics import load_statistics
from sb3_sparse.loading.zips import read_model
from sb3_sparse.policies.internals import LAST_SEEN
from sb3_sparse.policies.saving import differ
from sb3_sparse.zoo.folder import VECNORMALIZE
from sb3_sparse.zoo.run_files import CONFIG
from sb3_sparse.zoo.spec import algorithms


def statistics_of(
    path: Path,
    algo: str,
    given: Path | None,
    parameters: Path | None,
    settings: Mapping[str, Any],
) -> Path | None:
    """Return the file of the statistics that normalised a model's observations; None: nothing did.

    :param path: the model's zip
    :param algo: its algorithm
    :param given: the file that the user names; None: that of the model's run
    :param parameters: folder of its run's ``config.yml``; None: it has no run
    :param settings: how its run made environments
    :raises ConfigError: if the file is missing, or it is unclear whether there should be one
    """
    found = given
    if given is None:
        if parameters is None:
            _check_lone(path, algo)
            return None
        found = _statistics_of_run(parameters, settings)
    if found is not None and not found.is_file():
        raise ConfigError(
            f"there is no file {found}; give what VecNormalize.save wrote, e.g. {VECNORMALIZE}"
        )
    return found


def normalized(envs: VecEnv, statistics: Path, training: bool) -> VecEnv:
    """Normalise observations by saved statistics.

    :param statistics: the file
    :param training: whether statistics are updated, and rewards normalised if they were
    :raises SparsityError: as :func:`~sb3_sparse.loading.statistics.load_statistics`
    """
    envs = load_statistics(statistics, envs)
    envs.training = training
    envs.norm_reward = training and envs.norm_reward
    return envs


def _statistics_of_run(parameters: Path, settings: Mapping[str, Any]) -> Path | None:
    """Return the statistics file in a run's folder; None if the run was not normalised.

    :raises ConfigError: if the file is missing though the run was normalised, or the reverse
    """
    path = parameters / VECNORMALIZE
    if settings["normalize"] and not path.is_file():
        raise ConfigError(
            f"the run in {parameters.parent} normalised its observations, but {path} is missing; "
            "give the statistics with --vecnormalize FILE"
        )
    if path.is_file() and not settings["normalize"]:
        raise ConfigError(
            f"{path} exists, though by {parameters / CONFIG} nothing was normalised; give "
            f"--vecnormalize {path} to use it, or remove it"
        )
    return path if settings["normalize"] else None


def _check_lone(path: Path, algo: str) -> None:
    """Reject a zip outside a run whose observations were, or may have been, normalised.

    :raises ConfigError: explaining which statistics to give
    """
    for beside in (path.with_name(VECNORMALIZE), path.with_suffix("") / VECNORMALIZE):
        if beside.is_file():
            raise ConfigError(
                f"{beside} is beside {path}: give --vecnormalize {beside} if it normalised the "
                "observations of this model, else move it elsewhere"
            )
    if issubclass(algorithms()[algo], OnPolicyAlgorithm):
        data = read_attributes(path, True) if is_sbx(path) else read_model(path)[0]
        if differ(*map(data.get, LAST_SEEN[:2])):
            raise ConfigError(
                f"{path} was trained with VecNormalize; give its statistics with --vecnormalize "
                "FILE, even if it normalised only rewards"
            )
