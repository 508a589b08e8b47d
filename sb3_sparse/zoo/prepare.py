"""What is checked of a run before it is trained."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from gymnasium import spaces

from sb3_sparse.errors import ConfigError, MissingExtra, SparsityError, Unwritable
from sb3_sparse.policies.registry import registered
from sb3_sparse.zoo.disk import refusal
from sb3_sparse.zoo.manager import spaces_of
from sb3_sparse.zoo.match import Match, match_parameters, untrained_policy
from sb3_sparse.zoo.record import sparsity_of, versions, write_record
from sb3_sparse.zoo.settings import method_of
from sb3_sparse.zoo.spec import RunSpec


@dataclass(frozen=True)
class Prepared:
    """What is known of a run before it is trained.

    :param settings: as it shall be trained; widths of a dense network that matches a sparse one's
        parameters are in it
    :param evaluation: ``eval_freq`` and ``eval_episodes``
    :param observation_space: that the policy sees, wrappers and stacking included
    :param action_space: that it acts in
    """

    settings: dict[str, Any]
    evaluation: dict[str, int]
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    match: Match | None

    def record(self, run: RunSpec) -> dict[str, Any]:
        """What ``sparsity.json`` says of the run from its start."""
        match = {} if self.match is None else {"match": asdict(self.match)}
        return {
            "method": method_of(self.settings),
            "run": run.as_dict(),
            "settings": self.settings,
            "evaluation": self.evaluation,
            "versions": versions(),
            **match,
        }


def prepare(run: RunSpec, log_folder: Path) -> Prepared:
    """Check a run and make its environment once, without training or writing anything.

    :raises ConfigError: if something is wrong with device, settings or environment, or the
        algorithm cannot act in it
    """
    check_device(run.device)
    settings, evaluation = run.settings(), run.evaluation()
    with explained(doubt(run), run.env_id):
        observation_space, action_space = spaces_of(
            run, settings, log_folder / run.algo / "new", evaluation
        )
    check_action_space(run, action_space)
    match = None
    if run.match_params is not None:
        match = match_parameters(
            run.algorithm, observation_space, action_space, settings, run.match_params
        )
        settings["policy_kwargs"] = match.policy_kwargs
    return Prepared(settings, evaluation, observation_space, action_space, match)


def check_device(device: str) -> None:
    """Refuse a device that this machine does not have.

    :raises ConfigError: if so
    """
    if device == "auto":
        return
    here = ["auto", "cpu"] + (["cuda"] if th.cuda.is_available() else [])
    try:
        th.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # its own words, of torch
        raise ConfigError(
            f"there is no device {device!r} here; give --device {' or '.join(here)}"
        ) from error


def count(run: RunSpec, folder: Path) -> None:
    """Record what a run's networks would hold and cost, in a folder of its own; no training.

    Networks that would be pruned are counted as they end, not as they begin.

    :param folder: as of :func:`sb3_sparse.zoo.training.train`
    :raises ConfigError: as :func:`prepare`
    """
    prepared = prepare(run, folder.parent.parent)
    kwargs = {**prepared.settings["policy_kwargs"], "initial_sparsity": None}
    policy = untrained_policy(
        run.algorithm,
        prepared.observation_space,
        prepared.action_space,
        {**prepared.settings, "policy_kwargs": kwargs},
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_record(folder, status="counted", **prepared.record(run), **sparsity_of(policy))


def doubt(run: RunSpec) -> str:
    """What to say when an environment or algorithm fails before training."""
    return f"the settings of {run.env_id} in {run.config}, with what you changed, do not work"


@contextmanager
def explained(failure: str, env_id: str) -> Iterator[None]:
    """Turn what environment, zoo and algorithm raise before training into one of our errors.

    :param failure: what does not work then
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
        raise ConfigError(f"{failure}: {type(error).__name__}: {error}") from error


def check_action_space(run: RunSpec, space: spaces.Space[Any]) -> None:
    """Refuse an environment whose actions the algorithm cannot choose.

    :raises ConfigError: if so
    """
    able = [
        name.lower()
        for name, one in registered().items()
        if isinstance(space, one.policy.action_spaces)
    ]
    if run.algo not in able:
        raise ConfigError(
            f"{run.algo} cannot act in {run.env_id}, whose actions are {space}; "
            + (f"take {' or '.join(able)}" if able else "no algorithm can")
        )
