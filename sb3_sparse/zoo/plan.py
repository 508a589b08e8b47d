"""What a run on record is to do, for going on with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_sparse.errors import CorruptStateError
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.statistics import read_statistics
from sb3_sparse.loading.zips import read_model
from sb3_sparse.zoo.arguments import is_whole
from sb3_sparse.zoo.folder import VECNORMALIZE, params_of
from sb3_sparse.zoo.record import CURE, NAME, WHAT
from sb3_sparse.zoo.saved import Saved, check_attributes
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.validation import check_settings


@dataclass(frozen=True)
class Plan:
    """What a record says of a run that has begun.

    :param run: what is trained
    :param settings: as it is trained
    :param evaluation: ``eval_freq`` and ``eval_episodes``
    :param tensorboard_log: where TensorBoard's files go; empty: none
    """

    run: RunSpec
    settings: dict[str, Any]
    evaluation: dict[str, int]
    tensorboard_log: str


def planned(folder: Path, record: Mapping[str, Any]) -> Plan:
    """The plan in a run's record.

    :param folder: the run's own
    :param record: the content of its ``sparsity.json``
    :raises ConfigError: if the run cannot be made here, e.g. an environment is not known
    :raises CorruptStateError: if something is missing, or of another type
    """
    path = folder / NAME
    with reading(path, WHAT, CURE):
        settings, evaluation = record["settings"], record["evaluation"]
        for name, value in (("settings", settings), ("evaluation", evaluation)):
            if not isinstance(value, dict):
                raise CorruptStateError(f"{path} is damaged: {name} is {value!r}; {CURE}")
        for name in ("eval_freq", "eval_episodes"):
            if not is_whole(evaluation[name]) or evaluation[name] < 1:
                raise CorruptStateError(
                    f"{path} is damaged: {name} is {evaluation[name]!r}; {CURE}"
                )
        run = RunSpec(**record["run"])
        check_settings(settings, run.algorithm)
        if "n_timesteps" not in settings:
            raise CorruptStateError(f"{path} is damaged: its settings lack n_timesteps; {CURE}")
        return Plan(run, settings, evaluation, str(record["tensorboard_log"]))


def check_start(start: Path, run: RunSpec) -> None:
    """Refuse a model or statistics that training cannot go on from.

    :param start: folder of a checkpoint, or of the run
    :param run: what is trained
    :raises ConfigError: if there is no model
    :raises CorruptStateError: if one of the two files is damaged
    :raises Diverged: if one of them is not finite
    """
    params = params_of(start, run.env_id)
    saved = Saved(params.with_name(f"{params.name}.zip"), run.algo)
    saved.load()
    check_attributes(saved.path, run.algo, read_model(saved.path)[0])
    if (params / VECNORMALIZE).is_file():
        read_statistics(params / VECNORMALIZE)
