"""What an interrupted run goes on from."""

from __future__ import annotations

import json
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sparse.zoo.evaluation import NPZ, Evaluation
from sb3_sparse.zoo.record import write_record

FOLDER = "resume"
STATE = "state.json"
REPLAY_BUFFER = "replay_buffer.pkl"


class Checkpoints(BaseCallback):
    """Saves everything after each evaluation, and stops cleanly when asked.

    Saves at the start of a rollout, when all experience has been learnt from. A checkpoint is a
    folder ``resume/<steps>`` in the layout that rl-zoo's ``--trained-agent`` reads (model, replay
    buffer, normalisation); it appears whole or not at all, and then the one before goes.

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
        self.stopped = False

    def _on_training_start(self) -> None:
        self.saved_evaluations = self.evaluation.count

    def _on_rollout_start(self) -> None:
        evaluated = self.evaluation.count > self.saved_evaluations
        if evaluated or self.stop_wanted:
            self.save()
            self.saved_evaluations = self.evaluation.count
            self.stopped = self.stop_wanted

    def _on_step(self) -> bool:
        return not self.stopped

    def save(self) -> None:
        """Save the model as it is now."""
        final = self.parent_folder / str(self.model.num_timesteps)
        if final.exists():
            return
        new = self.parent_folder / "unfinished"
        shutil.rmtree(new, ignore_errors=True)
        (new / self.env_name).mkdir(parents=True)
        self.model.save(new / f"{self.env_name}.zip")
        if isinstance(self.model, OffPolicyAlgorithm):
            self.model.save_replay_buffer(new / REPLAY_BUFFER)
        normalization = self.model.get_vec_normalize_env()
        if normalization is not None:
            normalization.save(str(new / self.env_name / "vecnormalize.pkl"))
        if self.evaluation.count:
            shutil.copy(self.evaluation.folder / NPZ, new / NPZ)
        (new / STATE).write_text(json.dumps(self.evaluation.state()))
        new.rename(final)
        write_record(self.parent_folder.parent, num_timesteps=self.model.num_timesteps)
        for other in self.parent_folder.iterdir():
            if other != final:
                shutil.rmtree(other)

    def restore(self, checkpoint: Path) -> None:
        """Take back the evaluations of a checkpoint, whose model the engine has loaded."""
        self.evaluation.restore(json.loads((checkpoint / STATE).read_text()), checkpoint / NPZ)

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
                "\nStopping at the end of this rollout; Ctrl-C again stops at once and falls back "
                "to the last evaluation",
                file=sys.stderr,
            )

        before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def last_checkpoint(folder: Path) -> Path | None:
    """The newest complete checkpoint of a run; None if it has none."""
    found = [path for path in (folder / FOLDER).glob("*") if path.name.isdigit()]
    return max(found, key=lambda path: int(path.name), default=None)


def clear_checkpoints(folder: Path) -> None:
    """Remove what only an interrupted run needs."""
    shutil.rmtree(folder / FOLDER, ignore_errors=True)
