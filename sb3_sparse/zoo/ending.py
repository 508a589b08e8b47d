"""Handles runs that end early: what is recorded, and what is raised."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_sparse.errors import Diverged, SparsityError, Unwritable, command
from sb3_sparse.zoo.checkpoint import StopTraining
from sb3_sparse.zoo.disk import refusal
from sb3_sparse.zoo.divergence import check_actions, check_networks
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import Status


@contextmanager
def recorded(folder: RunFolder, env_id: str, model: BaseAlgorithm) -> Iterator[None]:
    """Record any error that ends the run.

    :raises Diverged: naming the policy that is kept
    :raises Unwritable: explaining how to resume
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
                raise  # else the record stays "running", as after a kill
        if refused is None:
            raise
        raise Unwritable(f"{refused}. {_how_to_resume(folder, model)}") from error


def _diverged(folder: RunFolder, env_id: str, model: BaseAlgorithm, error: Diverged) -> Diverged:
    """Record the divergence, and keep the last policy whose networks are finite."""
    step = folder.take_last_checkpoint(env_id)
    kept = (
        "no policy was saved before" if step is None else f"the last policy is that of step {step}"
    )
    folder.write(
        status=Status.DIVERGED,
        error=f"{error}. In {folder.path.name} {kept}",  # other machines read this too
        num_timesteps=model.num_timesteps,
        last_policy=step,
    )
    folder.clear_checkpoints()
    return Diverged(f"{error}. In {folder} {kept}")


def _how_to_resume(folder: RunFolder, model: BaseAlgorithm) -> str:
    if model.num_timesteps == 0:
        return "Nothing was trained yet; free space or make it writable, then start again"
    checkpoint = folder.last_checkpoint()
    kept = "from its start" if checkpoint is None else f"from step {checkpoint.name}"
    return (
        f"The run stopped at step {model.num_timesteps}. Free space or make the folder writable; "
        f"then resume it {kept}: {command('train', '--resume', folder)}"
    )


@contextmanager
def diverging(model: BaseAlgorithm) -> Iterator[None]:
    """Raise Diverged in place of an error that comes from networks with NaN or huge weights."""
    try:
        yield
    except (SparsityError, StopTraining):
        raise
    except Exception as error:
        try:
            check_networks(model)
            check_actions(model, error)
        except Diverged as diverged:
            raise diverged from error
        raise
