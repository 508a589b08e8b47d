"""The folder of a run, as rl-zoo lays it out: its one owner."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from sb3_sparse.errors import ConfigError, CorruptStateError, RunBusy
from sb3_sparse.files import written_whole
from sb3_sparse.loading.text import read_json
from sb3_sparse.loading.zooyaml import check_built, read_zoo_yaml
from sb3_sparse.zoo.disk import writing
from sb3_sparse.zoo.environments import package_names, plain_id
from sb3_sparse.zoo.record import CURE, FORMAT, NAME, WHAT, Record, as_json

VECNORMALIZE = "vecnormalize.pkl"
CONFIG = "config.yml"
ARGUMENTS = "args.yml"
BEST = "best_model.zip"
EVALUATIONS = "evaluations.npz"
MONITOR = ".monitor.csv"
REPLAY_BUFFER = "replay_buffer"
EXAMPLE = "logs/sac/HalfCheetah-v5_1"
OF_ENVIRONMENT = ("env_wrapper", "vec_env_wrapper", "frame_stack", "env_kwargs", "normalize")
"""The settings that decide how a run's environments are made."""
RESTORE = "restore it, or copy the zip out of the folder and give it with --env and --vecnormalize"
PATIENCE = 1.0  # seconds; others hold the lock for a moment to see whether it is free


def env_name(env_id: str) -> str:
    """An environment's id as files and folders have it: ``"ALE-Pong-v5"`` for ``"ALE/Pong-v5"``."""
    return env_id.replace("/", "-")


@dataclass(frozen=True)
class Start:
    """Where a process takes a run up.

    :param folder: holds the model to load: a checkpoint or the run's own folder; None: a new model
    :param steps: environment steps done
    :param trained: whether only the last evaluation is left
    """

    folder: Path | None = None
    steps: int = 0
    trained: bool = False


@dataclass(frozen=True)
class RunFolder:
    """A run's folder, and the only reader and writer of its ``sparsity.json``.

    It holds ``<env>.zip`` (the last policy), ``best_model.zip``, ``evaluations.npz``,
    ``<env>/config.yml``, ``<env>/args.yml`` and ``<env>/vecnormalize.pkl`` as of ``rl_zoo3.train``,
    ``sparsity.json``, and, until the run is over, its checkpoint in ``resume/<steps>``. Nothing is
    read or written before a method is called.

    Example::

        from pathlib import Path
        from sb3_sparse.zoo import RunFolder

        folder = RunFolder(Path("logs/dqn/CartPole-v1_1"))
        if folder.has_record:
            print(folder.record().status, folder.record()["total"]["sparsity"])

    :param path: e.g. ``Path("logs/dqn/CartPole-v1_1")``
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
            with suppress(FileExistsError):  # another run was quicker
                path.mkdir()
                return cls(path)

    # The record.

    @property
    def has_record(self) -> bool:
        """Whether there is a ``sparsity.json``, which runs of ``rl_zoo3.train`` lack."""
        return (self.path / NAME).is_file()

    def record(self) -> Record:
        """The content of ``sparsity.json``.

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
        """Write ``sparsity.json``, whole or not at all. Entries of other names stay."""
        path = self.path / NAME
        known = read_json(path, WHAT, CURE) if self.has_record else {"format": FORMAT}
        with written_whole(path) as new:
            new.write_text(as_json({**known, **content}))

    # The models, and what belongs to them.

    @property
    def is_run(self) -> bool:
        """Whether this is the folder of a run, of ``sb3-sparse train`` or ``rl_zoo3.train``."""
        return len(list(self.path.glob(f"*/{ARGUMENTS}"))) == 1

    @property
    def evaluations(self) -> Path:
        """The evaluations during training."""
        return self.path / EVALUATIONS

    def parameters(self, env_id: str) -> Path:
        """The folder of the run's ``config.yml`` and normalisation."""
        return self.path / env_name(env_id)

    def model(self, env_id: str, best: bool = False) -> Path:
        """The last or best policy.

        :raises ConfigError: if there is none
        """
        path = self.path / (BEST if best else f"{env_name(env_id)}.zip")
        if not path.is_file():
            models = ", ".join(sorted(file.name for file in self.path.glob("*.zip"))) or "none"
            why = (
                "there is a best policy after the first evaluation at the sparsity asked for"
                if best
                else "a run that was killed has its last policy after sb3-sparse train --resume"
            )
            raise ConfigError(f"{self} has no {path.name} (its models: {models}): {why}")
        return path

    def arguments(self) -> dict[str, Any]:
        """What the run was started with, from the file that rl-zoo writes.

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
        arguments = read_zoo_yaml(path, RESTORE)
        for name in ("algo", "env"):
            if not isinstance(arguments.get(name), str):
                raise CorruptStateError(
                    f"{path} is damaged: {name} must be a name, got {arguments.get(name)!r}; "
                    f"{RESTORE}"
                )
        kwargs = arguments.get("env_kwargs")
        check_built(kwargs, f"env_kwargs in {path}")
        if kwargs is not None and not _names(kwargs):
            raise CorruptStateError(
                f"{path} is damaged: env_kwargs must map names to values, got {kwargs!r}; {RESTORE}"
            )
        return arguments

    def _check_compression(self) -> None:
        """Tell the folder of ``sb3-sparse compress`` from that of a run."""
        path = self.path / "compress.json"
        if not path.is_file():
            return
        cure = "give its command again with another --out"
        if read_json(path, "record of a compression", cure).get("finished"):
            raise ConfigError(f"{self} is no run's folder; give the zip in it")
        raise ConfigError(
            f"the compression in {self} is not finished; give its command again, and it goes on"
        )

    # The lock and the checkpoints.

    @property
    def _lock(self) -> Path:
        return self.path / ".lock"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from training the run within.

        :raises RunBusy: if one does already
        :raises Unwritable: if the folder cannot be written to
        """
        lock = FileLock(self._lock)
        try:
            with writing(self.path, "free space or make it writable, and give the command again"):
                lock.acquire(timeout=PATIENCE)
        except Timeout as error:
            raise RunBusy(f"another process is at work in {self}") from error
        try:
            yield
        finally:
            with suppress(OSError):  # Windows keeps an open file
                self._lock.unlink()
            lock.release()

    def is_locked(self) -> bool:
        """Whether some process trains the run now; nothing is written."""
        try:
            descriptor = os.open(self._lock, os.O_RDONLY)
        except FileNotFoundError:
            return False
        try:
            return not _can_lock(descriptor)
        finally:
            os.close(descriptor)

    @property
    def checkpoints(self) -> Path:
        """The folder of checkpoints, each called by its environment steps."""
        return self.path / "resume"

    def last_checkpoint(self) -> Path | None:
        """The newest whole checkpoint; None if there is none."""
        found = [path for path in self.checkpoints.glob("*") if path.name.isdigit()]
        return max(found, key=lambda path: int(path.name), default=None)

    def start(self) -> Start:
        """Where the run resumes."""
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
        """Remove what only an interrupted run needs."""
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def clear_leftovers(self) -> None:
        """Remove what a run without a record left, unless some process is at it."""
        self.path.mkdir(parents=True, exist_ok=True)
        with self.locked():
            if self.has_record:  # it has begun since
                return
            for path in self.path.iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
                elif path != self._lock:
                    path.unlink()


def environment_in(arguments: Mapping[str, Any]) -> tuple[str | None, tuple[str, ...]]:
    """The environment's plain id in a run's arguments, and the modules that register it.

    :param arguments: as :meth:`RunFolder.arguments` returns them
    """
    packages = package_names(arguments.get("gym_packages"))
    env_id = arguments.get("env")
    return (None, packages) if env_id is None else plain_id(str(env_id), packages)


def environment_settings(parameters: Path) -> dict[str, Any]:
    """How a run's environments are made: wrappers, stacking, arguments, whether normalised.

    :param parameters: folder of the run's ``config.yml``
    :return: those of :data:`OF_ENVIRONMENT` that the file has, ``normalize`` as a truth value
    :raises ConfigError: if there is no such file
    :raises CorruptStateError: if it is damaged
    """
    path = parameters / CONFIG
    if not path.is_file():
        raise ConfigError(
            f"{path} is missing, which says how the run's environment was wrapped, stacked and "
            f"normalised; {RESTORE}"
        )
    content = read_zoo_yaml(path, RESTORE)
    settings = {
        name: content[name] for name in OF_ENVIRONMENT if content.get(name) not in (None, 0)
    }
    check_built(settings, str(path))
    stack = settings.get("frame_stack", 1)
    allowed = {
        "frame_stack": type(stack) is int and 1 <= stack <= 1000,
        "env_kwargs": _names(settings.get("env_kwargs", {})),
        **{name: _wrappers(settings.get(name, [])) for name in ("env_wrapper", "vec_env_wrapper")},
    }
    for name, fits in allowed.items():
        if not fits:
            raise CorruptStateError(
                f"{path} is damaged: {name} cannot be {settings[name]!r}; {RESTORE}"
            )
    settings["normalize"] = bool(settings.get("normalize", False))
    return settings


def zip_path(path: Path) -> Path:
    """The path with the suffix that SB3 adds, where it was left out."""
    if not path.name or path.suffix:
        return path
    with_suffix = path.with_suffix(".zip")
    return with_suffix if with_suffix.is_file() else path


def _names(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


def _wrappers(value: Any) -> bool:
    """Whether it is a dotted path, a path with its arguments, or a list of these."""
    return all(
        isinstance(one, str)
        or (_names(one) and len(one) == 1 and all(_names(given) for given in one.values()))
        for one in (value if isinstance(value, list) else [value])
    )


def _can_lock(descriptor: int) -> bool:
    if sys.platform == "win32":
        import msvcrt

        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            msvcrt.locking(descriptor, msvcrt.LK_UNLCK, 1)
        except OSError:
            return False
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # gone when it is closed
    except BlockingIOError:
        return False
    return True
