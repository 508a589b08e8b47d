"""The folder of a run, in rl-zoo's layout: one class reads and writes it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_sparse.errors import ConfigError, did_you_mean
from sb3_sparse.files import written_whole
from sb3_sparse.loading.text import read_json
from sb3_sparse.zoo.lock import is_locked, locked
from sb3_sparse.zoo.record import CURE, FORMAT, NAME, WHAT, Record, as_json
from sb3_sparse.zoo.run_files import ARGUMENTS, read_arguments

VECNORMALIZE = "vecnormalize.pkl"
BEST = "best_model.zip"
EVALUATIONS = "evaluations.npz"
MONITOR = ".monitor.csv"
REPLAY_BUFFER = "replay_buffer"
EXAMPLE = "logs/sac/HalfCheetah-v5_1"


def env_name(env_id: str) -> str:
    """Return an environment's id for file names: ``"ALE-Pong-v5"`` for ``"ALE/Pong-v5"``."""
    return env_id.replace("/", "-")


@dataclass(frozen=True)
class Start:
    """The point from which a process starts or resumes a run.

    :param folder: folder of the model to load, a checkpoint or the run's; None: a new model
    :param steps: environment steps done
    :param trained: whether only the final evaluation is left
    """

    folder: Path | None = None
    steps: int = 0
    trained: bool = False


@dataclass(frozen=True)
class RunFolder:
    """A run's folder, and the only reader and writer of its ``sparsity.json``.

    It holds ``<env>.zip`` (the last policy), ``best_model.zip``, ``evaluations.npz``,
    ``<env>/config.yml``, ``<env>/args.yml`` and ``<env>/vecnormalize.pkl`` as ``rl_zoo3.train``
    writes them, ``sparsity.json`` and, until the run ends, its checkpoint in ``resume/<steps>``.
    Constructing a RunFolder reads and writes nothing.

    Example::

        from pathlib import Path
        from sb3_sparse.zoo import RunFolder

        folder = RunFolder(Path("logs/dqn/CartPole-v1_1"))
        if folder.has_record:
            print(folder.record().status, folder.record()["total"]["sparsity"])

    :param path: the folder, e.g. ``Path("logs/dqn/CartPole-v1_1")``
    """

    path: Path

    def __str__(self) -> str:
        return str(self.path)

    @classmethod
    def new(cls, log_folder: Path, algo: str, env_id: str) -> RunFolder:
        """Make ``<log_folder>/<algo>/<env>_<n>`` with the next free number."""
        parent, name = log_folder / algo, env_name(env_id)
        parent.mkdir(parents=True, exist_ok=True)
        while True:
            numbers = (one.name.removeprefix(f"{name}_") for one in parent.glob(f"{name}_*"))
            taken = [int(number) for number in numbers if number.isdigit()]
            path = parent / f"{name}_{max(taken, default=0) + 1}"
            with suppress(FileExistsError):  # another run was faster
                path.mkdir()
                return cls(path)

    # The record.

    @property
    def has_record(self) -> bool:
        """Whether there is a ``sparsity.json``, which runs of ``rl_zoo3.train`` lack."""
        return (self.path / NAME).is_file()

    def record(self) -> Record:
        """Read ``sparsity.json``.

        :raises ConfigError: if the folder has none
        :raises CorruptStateError: if it is damaged
        """
        path = self.path / NAME
        if not self.has_record:
            raise ConfigError(
                f"there is no run of sb3-sparse in {self} (it would hold {NAME}); give the run's "
                f"own folder, e.g. {EXAMPLE}"
            )
        return Record(read_json(path, WHAT, CURE), path)

    def write(self, **content: Any) -> None:
        """Update entries of ``sparsity.json``, writing the file completely or not at all."""
        path = self.path / NAME
        known = read_json(path, WHAT, CURE) if self.has_record else {"format": FORMAT}
        with written_whole(path) as new:
            new.write_text(as_json({**known, **content}))

    # The models and their files.

    @property
    def is_run(self) -> bool:
        """Whether ``sb3-sparse train`` or ``rl_zoo3.train`` made this folder for a run."""
        return len(list(self.path.glob(f"*/{ARGUMENTS}"))) == 1

    @property
    def evaluations(self) -> Path:
        """The file of the evaluations during training."""
        return self.path / EVALUATIONS

    def parameters(self, env_id: str) -> Path:
        """The folder of the run's ``config.yml`` and normalisation."""
        return self.path / env_name(env_id)

    def model(self, env_id: str, best: bool = False) -> Path:
        """Return the file of the last or the best policy.

        :raises ConfigError: if there is no such file
        """
        path = self.path / (BEST if best else f"{env_name(env_id)}.zip")
        if not path.is_file():
            models = ", ".join(sorted(file.name for file in self.path.glob("*.zip"))) or "none"
            why = (
                "a best policy exists after the first evaluation at the requested sparsity"
                if best
                else "a killed run gets its last policy from sb3-sparse train --resume"
            )
            raise ConfigError(f"{self} has no {path.name} (its models: {models}): {why}")
        return path

    def arguments(self) -> dict[str, Any]:
        """Read the arguments that the run was started with, from rl-zoo's file.

        :raises ConfigError: if there is no run
        :raises CorruptStateError: if the file is damaged
        """
        files = list(self.path.glob(f"*/{ARGUMENTS}"))
        if not files:
            self._check_compression()
        if len(files) != 1:
            raise ConfigError(
                f"there is no run in {self}; give the run's own folder, e.g. {EXAMPLE}"
            )
        (path,) = files
        return read_arguments(path)

    def _check_compression(self) -> None:
        """Raise if this folder is one of ``sb3-sparse compress``."""
        path = self.path / "compress.json"
        if not path.is_file():
            return
        cure = "repeat its command with another --out"
        if read_json(path, "record of a compression", cure).get("finished"):
            raise ConfigError(f"{self} is not a run's folder; give the zip in it")
        raise ConfigError(
            f"the compression in {self} is not finished; repeat its command to continue it"
        )

    # The lock and the checkpoints.

    @property
    def _lock(self) -> Path:
        return self.path / ".lock"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from training the run.

        :raises RunBusy: if another process trains it already
        :raises Unwritable: if the folder is not writable
        """
        with locked(self._lock):
            yield

    def is_locked(self) -> bool:
        """Whether a process is training the run; the check writes nothing."""
        return is_locked(self._lock)

    @property
    def checkpoints(self) -> Path:
        """The folder of checkpoints, each named after its environment steps."""
        return self.path / "resume"

    def last_checkpoint(self) -> Path | None:
        """Return the newest complete checkpoint, or None."""
        found = [path for path in self.checkpoints.glob("*") if path.name.isdigit()]
        return max(found, key=lambda path: int(path.name), default=None)

    def start(self) -> Start:
        """Return the point from which the run resumes."""
        if self.record().get("trained"):
            return Start(self.path, trained=True)
        checkpoint = self.last_checkpoint()
        return Start() if checkpoint is None else Start(checkpoint, int(checkpoint.name))

    def take_last_checkpoint(self, env_id: str) -> int | None:
        """Make the last checkpoint's model the run's last policy.

        :return: its environment steps; None if there is no checkpoint
        """
        checkpoint = self.last_checkpoint()
        if checkpoint is None:
            return None
        name = env_name(env_id)
        shutil.copy(checkpoint / f"{name}.zip", self.path / f"{name}.zip")
        for path in (checkpoint / name).iterdir():  # its normalisation
            shutil.copy(path, self.path / name / path.name)
        return int(checkpoint.name)

    def clear_checkpoints(self) -> None:
        """Remove the checkpoints, which only an interrupted run needs."""
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def clear_leftovers(self) -> None:
        """Remove the files of a run without a record, unless a process is training it."""
        self.path.mkdir(parents=True, exist_ok=True)
        with self.locked():
            if self.has_record:  # it has started since
                return
            for path in self.path.iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
                elif path != self._lock:
                    path.unlink()


def locate(path: Path | str, best: bool = False) -> tuple[Path, RunFolder]:
    """Return a model's zip and its folder, which may be a run's.

    :param path: a run's folder, or a zip, with or without its suffix
    :param best: take a folder's best policy instead of its last
    :raises ConfigError: if a folder holds no run or no such model
    """
    path = Path(path)
    if not RunFolder(path).is_run:  # a run may have a folder that is named like its zip
        path = _zip_path(path)
    if not path.suffix and not path.exists():
        near = did_you_mean(path.name, (one.name for one in path.parent.glob("*")))
        raise ConfigError(
            f"there is no run and no model {path}{near}; give a run's folder, e.g. {EXAMPLE}, or a "
            "model saved by SB3, e.g. model.zip"
        )
    if not path.is_dir():
        return path, RunFolder(path.parent)
    folder = RunFolder(path)
    return folder.model(folder.arguments()["env"], best), folder


def _zip_path(path: Path) -> Path:
    """Add the suffix that SB3 adds, if the path lacks one and the file exists."""
    if not path.name or path.suffix:
        return path
    with_suffix = path.with_suffix(".zip")
    return with_suffix if with_suffix.is_file() else path
