"""How a run ends that does not finish: what goes on record, and what is raised."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import Diverged, SparsityError, Unwritable, command
from sb3_sparse.zoo.checkpoint import (
    StopTraining,
    clear_checkpoints,
    keep_last_finite,
    last_checkpoint,
)
from sb3_sparse.zoo.disk import refusal
from sb3_sparse.zoo.divergence import check_networks
from sb3_sparse.zoo.record import DIVERGED, write_record


@contextmanager
def recorded(folder: Path, env_name: str, model: BaseAlgorithm) -> Iterator[None]:
    """Within it, whatever ends a run goes on record.

    :param folder: of the run
    :param env_name: file name of its model
    :raises Diverged: with what is left of the run
    :raises Unwritable: with how to go on
    """
    try:
        yield
    except Diverged as error:
        raise _diverged(folder, env_name, model, error) from error
    except Exception as error:
        refused = refusal(error, folder)
        try:
            reason = f"{type(error).__name__}: {error}" if refused is None else refused
            write_record(folder, status="failed", error=reason)
        except OSError:
            if refused is None:
                raise  # else the record stays at "running", as of a run that was killed
        if refused is None:
            raise
        raise Unwritable(f"{refused}. {_how_to_go_on(folder, model)}") from error


def _diverged(folder: Path, env_name: str, model: BaseAlgorithm, error: Diverged) -> Diverged:
    """Keep the last policy of numbers."""
    step = keep_last_finite(folder, env_name)
    kept = (
        "no policy was saved before" if step is None else f"the last policy is that of step {step}"
    )
    write_record(
        folder,
        status=DIVERGED,
        error=f"{error}. In {folder.name} {kept}",  # which other machines read, too
        num_timesteps=model.num_timesteps,
        last_policy=step,
    )
    clear_checkpoints(folder)
    return Diverged(f"{error}. In {folder} {kept}")


def _how_to_go_on(folder: Path, model: BaseAlgorithm) -> str:
    if model.num_timesteps == 0:
        return "Nothing was trained yet; free space or make it writable, and start again"
    checkpoint = last_checkpoint(folder)
    kept = "from its start" if checkpoint is None else f"from step {checkpoint.name}"
    return (
        f"The run stopped at step {model.num_timesteps}. Free space or make the folder writable; "
        f"then it goes on {kept}: {command('train', '--resume', folder)}"
    )


@contextmanager
def diverging(model: BaseAlgorithm) -> Iterator[None]:
    """Within it, an error of networks that hold NaN, which may say anything, is said to be that."""
    try:
        yield
    except (SparsityError, StopTraining):
        raise
    except Exception as error:
        try:
            check_networks(model)
        except Diverged as diverged:
            raise diverged from error
        raise
