"""Checks a run before it is trained."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces

from sb3_sparse.errors import (
    ConfigError,
    MissingExtra,
    SparsityError,
    Unwritable,
    place_of,
    raised_here,
)
from sb3_sparse.policies.registry import registered
from sb3_sparse.zoo.computing import counts_of
from sb3_sparse.zoo.disk import refusal
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.manager import spaces_of
from sb3_sparse.zoo.match import Match, match_parameters, untrained_policy
from sb3_sparse.zoo.record import Status
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.versions import versions


@dataclass(frozen=True)
class Prepared:
    """A run that has been checked and can be trained.

    :param settings: settings to train with, including the widths of a parameter match
    :param evaluation: ``eval_freq`` and ``eval_episodes``
    :param observation_space: the policy's observation space, wrappers and stacking included
    :param action_space: the policy's action space
    :param match: the parameter match, if the run asks for one
    """

    settings: Settings
    evaluation: dict[str, int]
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    match: Match | None

    def record(self, run: RunSpec) -> dict[str, Any]:
        """Return the entries that ``sparsity.json`` has from the start of the run."""
        match = {} if self.match is None else {"match": asdict(self.match)}
        return {
            "method": run.name_of(self.settings),
            "run": run.as_dict(),
            "settings": self.settings,
            "evaluation": self.evaluation,
            "versions": versions(),
            **match,
        }


def prepare(run: RunSpec, log_folder: Path) -> Prepared:
    """Check a run and make its environment once, without training or writing anything.

    :raises ConfigError: if device, settings or environment are invalid, or the algorithm cannot
        act in the environment
    """
    check_device(run.device)
    settings, evaluation = run.settings(), run.evaluation()
    with setup_errors(settings_fail(run), run.env_id):
        observation_space, action_space = spaces_of(
            run, settings, RunFolder(log_folder / run.algo / "new"), evaluation
        )
    check_action_space(run, action_space)
    match = None
    if run.match_params is not None:
        match = match_parameters(
            run.algorithm, observation_space, action_space, settings, run.match_params
        )
        settings = settings.replaced(policy_kwargs=match.policy_kwargs)
    return Prepared(settings, evaluation, observation_space, action_space, match)


def check_device(device: str) -> None:
    """Raise if this machine does not have a device.

    :raises ConfigError: naming the devices that it has
    """
    if device == "auto":
        return
    here = ["auto", "cpu"] + (["cuda"] if th.cuda.is_available() else [])
    try:
        th.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch raises either
        raise ConfigError(
            f"there is no device {device!r} here; give --device {' or '.join(here)}"
        ) from error


def count(run: RunSpec, folder: RunFolder) -> None:
    """Record the size and cost of a run's networks in its folder, without training.

    Networks that would be pruned are counted at their final sparsity.

    :param folder: the run's folder, as in :func:`sb3_sparse.zoo.training.train`
    :raises ConfigError: as :func:`prepare`
    """
    prepared = prepare(run, folder.path.parent.parent)
    kwargs = {**prepared.settings.policy_kwargs, "initial_sparsity": None}
    policy = untrained_policy(
        run.algorithm,
        prepared.observation_space,
        prepared.action_space,
        prepared.settings.replaced(policy_kwargs=kwargs),
    )
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.write(status=Status.COUNTED, **prepared.record(run), **counts_of(policy))


def settings_fail(run: RunSpec) -> str:
    """Return the message for an environment or algorithm that fails before training."""
    return f"the settings of {run.env_id} in {run.config}, with your changes, do not work"


@contextmanager
def setup_errors(failure: str, env_id: str) -> Iterator[None]:
    """Turn errors of environment, zoo and algorithm before training into a ConfigError.

    An error raised in this package's own code is a bug and keeps its traceback.

    :param failure: what failed, for the message
    """
    try:
        yield
    except SparsityError:
        raise
    except gym.error.DependencyNotInstalled as error:
        if "mujoco" in str(error).lower():
            raise MissingExtra(env_id, "mujoco") from error
        raise ConfigError(f"{env_id} cannot be made: {error}") from error
    except Exception as error:
        refused = refusal(error, Path())
        if refused is not None:
            raise Unwritable(f"{refused}; free space, or make the folder writable") from error
        if raised_here(error):
            raise
        raise ConfigError(f"{failure}: {type(error).__name__}: {error}{place_of(error)}") from error


def check_action_space(run: RunSpec, space: spaces.Space[Any]) -> None:
    """Raise if the algorithm cannot choose an environment's actions.

    :raises ConfigError: naming the algorithms that can
    """
    able = [
        name.lower()
        for name, one in registered().items()
        if isinstance(space, one.policy.action_spaces)
    ]
    if run.algo not in able:
        raise ConfigError(
            f"{run.algo} cannot act in {run.env_id}, whose actions are {space}; "
            + (f"use {' or '.join(able)}" if able else "no algorithm can")
        )
