"""How a run ends that does not finish: what goes on record, and what is raised."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import Diverged, SparsityError, Unwritable, command
from sb3_sparse.zoo.checkpoint import StopTraining
from sb3_sparse.zoo.disk import refusal
from sb3_sparse.zoo.divergence import check_networks
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import Status


@contextmanager
def recorded(folder: RunFolder, env_id: str, model: BaseAlgorithm) -> Iterator[None]:
    """Put on record whatever ends the run within.

    :raises Diverged: with what is left of the run
    :raises Unwritable: with how to resume
    """
    try:
        yield
    except Diverged as error:
        raise _diverged(folder, env_id, model, error) from error
    except Exception as error:
        refused = refusal(error, folder.path)
        try:
            reason = f"{type(error).__name__}: {error}" if refused is None else refused
            folder.write(status=Status.FAILED, error=reason)
        except OSError:
            if refused is None:
                raise  # else the record stays at "running", as of a run that was killed
        if refused is None:
            raise
        raise Unwritable(f"{refused}. {_how_to_resume(folder, model)}") from error


def _diverged(folder: RunFolder, env_id: str, model: BaseAlgorithm, error: Diverged) -> Diverged:
    """Keep the last policy whose networks are finite."""
    step = folder.take_last_checkpoint(env_id)
    kept = (
        "no policy was saved before" if step is None else f"the last policy is that of step {step}"
    )
    folder.write(
        status=Status.DIVERGED,
        error=f"{error}. In {folder.path.name} {kept}",  # which other machines read, too
        num_timesteps=model.num_timesteps,
        last_policy=step,
    )
    folder.clear_checkpoints()
    return Diverged(f"{error}. In {folder} {kept}")


def _how_to_resume(folder: RunFolder, model: BaseAlgorithm) -> str:
    if model.num_timesteps == 0:
        return "Nothing was trained yet; free space or make it writable, and start again"
    checkpoint = folder.last_checkpoint()
    kept = "from its start" if checkpoint is None else f"from step {checkpoint.name}"
    return (
        f"The run stopped at step {model.num_timesteps}. Free space or make the folder writable; "
        f"then it goes on {kept}: {command('train', '--resume', folder)}"
    )


@contextmanager
def diverging(model: BaseAlgorithm) -> Iterator[None]:
    """Raise Diverged for whatever error networks that hold NaN cause within."""
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
