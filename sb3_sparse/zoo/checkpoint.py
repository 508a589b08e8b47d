"""Checkpoints, from which an interrupted run resumes."""

from __future__ import annotations

import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse.files import sync
from sb3_sparse.zoo.clock import Clock
from sb3_sparse.zoo.divergence import check_networks
from sb3_sparse.zoo.evaluation import Evaluation
from sb3_sparse.zoo.folder import MONITOR, REPLAY_BUFFER, VECNORMALIZE, RunFolder, env_name
from sb3_sparse.zoo.replay import BufferSaver

SECONDS = 120.0  # the most training that a kill may cost where evaluations are far apart


class StopTraining(Exception):
    """Raised at the start of a rollout to leave ``learn`` before another step is taken."""


class Checkpoints(BaseCallback):
    """Saves checkpoints after each evaluation and every two minutes, and stops cleanly on request.

    It saves at the start of a rollout, when training has used all experience. A checkpoint is a
    folder ``resume/<steps>``, written completely or not at all, which replaces the previous one.
    Its model and normalisation have the layout that rl-zoo's ``--trained-agent`` reads.

    :param folder: the run's folder
    :param env_id: environment that the model trains in
    :param evaluation: callback whose evaluations the checkpoint includes
    :param clock: paused during each save
    """

    def __init__(
        self, folder: RunFolder, env_id: str, evaluation: Evaluation, clock: Clock
    ) -> None:
        super().__init__()
        self.folder = folder
        self.env_name = env_name(env_id)
        self.evaluation = evaluation
        self.clock = clock
        self.stop_wanted = False
        self.buffer: BufferSaver | None = None

    def _on_training_start(self) -> None:
        if isinstance(self.model, OffPolicyAlgorithm):
            assert self.model.replay_buffer is not None
            self.buffer = BufferSaver(self.model.replay_buffer)
        self.saved_evaluations, self.saved_at = self.evaluation.count, time.monotonic()

    def _on_rollout_start(self) -> None:
        evaluated = self.evaluation.count > self.saved_evaluations
        late = time.monotonic() > self.saved_at + SECONDS
        if evaluated or late or self.stop_wanted:
            with self.clock.paused():
                self.save()
            self.saved_evaluations, self.saved_at = self.evaluation.count, time.monotonic()
        if self.stop_wanted:
            raise StopTraining

    def _on_step(self) -> bool:
        return True

    def save(self) -> None:
        """Save a checkpoint now.

        :raises Diverged: if the networks hold NaN; the previous checkpoint stays
        """
        check_networks(self.model)
        parent = self.folder.checkpoints
        final = parent / str(self.model.num_timesteps)
        if final.exists():
            return
        new = parent / "unfinished"
        shutil.rmtree(new, ignore_errors=True)
        try:
            self._write(new, final)
        except Exception:  # e.g. a full disk: make room to record the failure
            shutil.rmtree(new, ignore_errors=True)
            raise
        new.rename(final)
        sync(parent)
        self.folder.write(num_timesteps=self.model.num_timesteps, **self.clock.entry())
        for other in parent.iterdir():
            if other != final:
                shutil.rmtree(other)

    def _write(self, new: Path, final: Path) -> None:
        """Write everything into ``new``, which will be renamed ``final``."""
        (new / self.env_name).mkdir(parents=True)
        self.model.save(new / f"{self.env_name}.zip")
        if self.buffer is not None:
            rows = self.model.num_timesteps // self.model.n_envs
            self.buffer.save(new / REPLAY_BUFFER, rows)
            self.buffer.last = final / REPLAY_BUFFER
        normalization = self.model.get_vec_normalize_env()
        if normalization is not None:
            normalization.save(str(new / self.env_name / VECNORMALIZE))
        self.evaluation.save(new)
        for path in self.folder.path.glob(f"*{MONITOR}"):
            shutil.copy(path, new / path.name)
        sync(*new.rglob("*"), new)

    @contextmanager
    def on_signals(self) -> Iterator[None]:
        """Let SIGINT and SIGTERM request a stop; a second SIGINT interrupts at once."""
        if threading.current_thread() is not threading.main_thread():
            yield  # Python allows no handlers here
            return

        def ask(number: int, frame: FrameType | None) -> None:
            if self.stop_wanted:
                if number == signal.SIGINT:
                    raise KeyboardInterrupt
                return  # SIGTERM, which a launcher sends after a terminal's Ctrl-C
            self.stop_wanted = True
            print(
                "\nStopping at the end of this rollout; Ctrl-C again stops at once and falls back "
                "to the last checkpoint",
                file=sys.stderr,
            )

        before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def restored_monitors(folder: Path, checkpoint: Path | None) -> Iterator[None]:
    """Keep a checkpoint's training episodes under new names, and remove all later ones.

    ``0.monitor.csv`` becomes ``0.1.monitor.csv``, and so on: one file per start of the run, since
    SB3 reads times relative to each file's start. If the body raises, the files are restored.
    """
    before = {path: path.read_bytes() for path in folder.glob(f"*{MONITOR}")}
    after = _monitors_in(checkpoint)
    try:
        _replace_monitors(folder, {folder / name: content for name, content in after.items()})
        yield
    except BaseException:
        _replace_monitors(folder, before)
        raise


def _monitors_in(checkpoint: Path | None) -> dict[str, bytes]:
    """Return the content of a checkpoint's monitor files by their new names."""
    found: dict[str, bytes] = {}
    for path in [] if checkpoint is None else checkpoint.glob(f"*{MONITOR}"):
        rank, *part = path.name.removesuffix(MONITOR).split(".")
        if not part:
            part = [str(1 + len(list(path.parent.glob(f"{rank}.*{MONITOR}"))))]
        found[f"{rank}.{part[0]}{MONITOR}"] = path.read_bytes()
    return found


def _replace_monitors(folder: Path, contents: Mapping[Path, bytes]) -> None:
    for path in folder.glob(f"*{MONITOR}"):
        path.unlink()
    for path, content in contents.items():
        path.write_bytes(content)
