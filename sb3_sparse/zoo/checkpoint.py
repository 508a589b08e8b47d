"""What an interrupted run goes on from."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from filelock import FileLock, Timeout
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse.errors import ConfigError
from sb3_sparse.zoo.evaluation import Evaluation
from sb3_sparse.zoo.record import write_record
from sb3_sparse.zoo.replay import BufferSaver

FOLDER = "resume"
REPLAY_BUFFER = "replay_buffer"
MONITOR = ".monitor.csv"


class StopTraining(Exception):
    """Raised through ``learn`` at the start of a rollout, so that no further step is taken."""


class Checkpoints(BaseCallback):
    """Saves everything after each evaluation, and stops cleanly when asked.

    Saves at the start of a rollout, when all experience has been learnt from. A checkpoint is a
    folder ``resume/<steps>``; it appears whole or not at all, and then the one before goes. Model
    and normalisation lie in it as rl-zoo's ``--trained-agent`` reads them.

    :param folder: of the run
    :param env_name: file name of the model
    :param evaluation: whose evaluations belong to the checkpoint
    """

    def __init__(self, folder: Path, env_name: str, evaluation: Evaluation) -> None:
        super().__init__()
        self.parent_folder = folder / FOLDER
        self.env_name = env_name
        self.evaluation = evaluation
        self.stop_wanted = False
        self.buffer: BufferSaver | None = None

    def _on_training_start(self) -> None:
        if isinstance(self.model, OffPolicyAlgorithm):
            assert self.model.replay_buffer is not None
            self.buffer = BufferSaver(self.model.replay_buffer)
        self.saved_evaluations = self.evaluation.count

    def _on_rollout_start(self) -> None:
        evaluated = self.evaluation.count > self.saved_evaluations
        if evaluated or self.stop_wanted:
            self.save()
            self.saved_evaluations = self.evaluation.count
        if self.stop_wanted:
            raise StopTraining

    def _on_step(self) -> bool:
        return True

    def save(self) -> None:
        """Save the model as it is now."""
        final = self.parent_folder / str(self.model.num_timesteps)
        if final.exists():
            return
        new = self.parent_folder / "unfinished"
        shutil.rmtree(new, ignore_errors=True)
        (new / self.env_name).mkdir(parents=True)
        self.model.save(new / f"{self.env_name}.zip")
        if self.buffer is not None:
            rows = self.model.num_timesteps // self.model.n_envs
            self.buffer.save(new / REPLAY_BUFFER, rows)
            self.buffer.last = final / REPLAY_BUFFER
        normalization = self.model.get_vec_normalize_env()
        if normalization is not None:
            normalization.save(str(new / self.env_name / "vecnormalize.pkl"))
        self.evaluation.save(new)
        for path in self.parent_folder.parent.glob(f"*{MONITOR}"):
            shutil.copy(path, new / path.name)
        _to_disk(*new.rglob("*"), new)
        new.rename(final)
        _to_disk(self.parent_folder)
        write_record(self.parent_folder.parent, num_timesteps=self.model.num_timesteps)
        for other in self.parent_folder.iterdir():
            if other != final:
                shutil.rmtree(other)

    @contextmanager
    def on_signals(self) -> Iterator[None]:
        """Within it, SIGINT and SIGTERM ask for a stop; a second SIGINT interrupts at once."""
        if threading.current_thread() is not threading.main_thread():
            yield  # where Python allows no handlers
            return

        def ask(number: int, frame: FrameType | None) -> None:
            if self.stop_wanted and number == signal.SIGINT:
                raise KeyboardInterrupt
            self.stop_wanted = True
            print(
                "\nStopping as soon as this rollout has been learnt from; Ctrl-C again stops at "
                "once and falls back to the last evaluation",
                file=sys.stderr,
            )

        before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _to_disk(*paths: Path) -> None:
    """Wait until files and folders are on the disk, so that a power cut cannot lose them."""
    if os.name != "posix":
        return
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def last_checkpoint(folder: Path) -> Path | None:
    """The newest complete checkpoint of a run; None if it has none."""
    found = [path for path in (folder / FOLDER).glob("*") if path.name.isdigit()]
    return max(found, key=lambda path: int(path.name), default=None)


def restore_monitors(folder: Path, checkpoint: Path | None) -> None:
    """Set aside the training episodes that a checkpoint knows of, and forget all later ones.

    What was ``0.monitor.csv`` becomes ``0.1.monitor.csv``, and so on: a file for each time that the
    run was started, since SB3 reads times relative to a file's own start.
    """
    for path in folder.glob(f"*{MONITOR}"):
        path.unlink()
    if checkpoint is None:
        return
    for path in checkpoint.glob(f"*{MONITOR}"):
        rank, *part = path.name.removesuffix(MONITOR).split(".")
        if not part:
            part = [str(1 + len(list(checkpoint.glob(f"{rank}.*{MONITOR}"))))]
        shutil.copy(path, folder / f"{rank}.{part[0]}{MONITOR}")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Within it, no other process trains the run.

    :raises ConfigError: if one does already
    """
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise ConfigError(f"another process is at work in {folder}") from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows keeps an open file
            (folder / ".lock").unlink()
        lock.release()


def is_locked(folder: Path) -> bool:
    """Whether some process trains the run now."""
    if not (folder / ".lock").is_file():
        return False
    try:
        with locked(folder):
            return False
    except ConfigError:
        return True


def clear_checkpoints(folder: Path) -> None:
    """Remove what only an interrupted run needs."""
    shutil.rmtree(folder / FOLDER, ignore_errors=True)
