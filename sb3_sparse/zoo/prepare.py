"""What is checked of a run before it is trained."""

from __future__ import annotations

import traceback
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
from sb3_sparse.zoo.computing import counts_of
from sb3_sparse.zoo.disk import refusal
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.manager import spaces_of
from sb3_sparse.zoo.match import Match, match_parameters, untrained_policy
from sb3_sparse.zoo.record import Status, versions
from sb3_sparse.zoo.settings import Settings
from sb3_sparse.zoo.spec import RunSpec

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class Prepared:
    """What is known of a run before it is trained.

    :param settings: as it shall be trained; widths of a dense network that matches a sparse one's
        parameters are in it
    :param evaluation: ``eval_freq`` and ``eval_episodes``
    :param observation_space: that the policy sees, wrappers and stacking included
    :param action_space: that it acts in
    """

    settings: Settings
    evaluation: dict[str, int]
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    match: Match | None

    def record(self, run: RunSpec) -> dict[str, Any]:
        """What ``sparsity.json`` says of the run from its start."""
        match = {} if self.match is None else {"match": asdict(self.match)}
        return {
            "method": self.settings.method,
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


def count(run: RunSpec, folder: RunFolder) -> None:
    """Record what a run's networks would hold and cost, in a folder of its own; no training.

    Networks that would be pruned are counted as they end, not as they begin.

    :param folder: as of :func:`sb3_sparse.zoo.training.train`
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
    """What to say when an environment or algorithm fails before training."""
    return f"the settings of {run.env_id} in {run.config}, with what you changed, do not work"


@contextmanager
def setup_errors(failure: str, env_id: str) -> Iterator[None]:
    """Turn what environment, zoo and algorithm raise before training into a ConfigError.

    An error that this package raises itself is a bug of it, and keeps its traceback.

    :param failure: what fails then, for the message
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
        if _raised_here(error):
            raise
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


def _raised_here(error: BaseException) -> bool:
    """Whether code of this package raised an error, rather than code that it called."""
    frames = [frame.f_code.co_filename for frame, _ in traceback.walk_tb(error.__traceback__)]
    return Path(frames[-1]).is_relative_to(PACKAGE)
