"""Archive of ended runs: a JSON-lines file with one run per line, meant to be committed."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from sb3_sparse.errors import ConfigError, warn
from sb3_sparse.loading.arrays import read_arrays
from sb3_sparse.loading.guard import reading
from sb3_sparse.loading.text import read_text
from sb3_sparse.zoo.disk import writing
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import CURE as CURE_OF_RUN
from sb3_sparse.zoo.record import Record, Status

Array = npt.NDArray[np.float64]
Lines = Mapping[str, "Sequence[Archived]"]
"""An archive's lines by address, in file order."""
WHAT = "line of an archive"
CURE = "restore it from a copy, or remove the line; its run then counts as not done"
DECIMALS = 6  # returns are rounded as SB3's Monitor rounds them
BEGINNING = b'{"address"'


@dataclass(frozen=True, eq=False)
class Archived:
    """What an archive keeps of a run: everything except its models.

    :param address: identifies what was run
    :param record: content of the run's ``sparsity.json``, including settings and counts
    :param timesteps: environment steps at each evaluation, shape ``[T]``
    :param returns: episode returns of each evaluation, shape ``[T, episodes]``
    :param lengths: episode lengths in steps, shape ``[T, episodes]``
    :param measured: text of the run's measurement files, by file name
    """

    address: str
    record: Record
    timesteps: Array = field(default_factory=lambda: np.zeros(0))
    returns: Array = field(default_factory=lambda: np.zeros((0, 0)))
    lengths: Array = field(default_factory=lambda: np.zeros((0, 0)))
    measured: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_folder(cls, folder: RunFolder, address: str, files: Iterable[str] = ()) -> Archived:
        """Read a run's folder.

        :param files: names of the measurement files to read where they exist
        :raises ConfigError: if the folder holds no run, or the run has not ended
        :raises CorruptStateError: if a file is damaged
        """
        record, path = folder.record(), folder.evaluations
        if not record.status.is_over:
            raise ConfigError(f"the run in {folder} is not over: its status is {record.status}")
        found: dict[str, Any] = {}
        if record.status is Status.FINISHED or path.is_file():
            needed = ("timesteps", "results", "ep_lengths")
            saved = read_arrays(path, "file of evaluations", CURE_OF_RUN, needed)
            names = ("timesteps", "returns", "lengths")
            with reading(path, "file of evaluations", CURE_OF_RUN):
                found = _evaluations(
                    {name: saved[key] for name, key in zip(names, needed, strict=True)}
                )
        texts = {
            name: read_text(path, "file of measurements", CURE_OF_RUN).replace("\r\n", "\n")
            for name in files
            if (path := folder.path / name).is_file()
        }
        return cls(address, record, **found, measured=texts)

    @classmethod
    def of_line(cls, line: bytes, source: Path) -> Archived:
        """Parse a line that :meth:`line` wrote.

        :param source: file and line, for messages

        :raises Exception: of any kind, if the line is damaged; call it inside
            :func:`~sb3_sparse.loading.guard.reading`
        """
        content = json.loads(line.decode())
        if not isinstance(content, dict):
            raise ValueError(f"it holds a {type(content).__name__}, not a mapping")
        address, record, measured = (content[key] for key in ("address", "record", "measured"))
        if not isinstance(address, str) or not address:
            raise ValueError(f"its address is {address!r}")
        record = Record(record, source, CURE)
        if not record.status.is_over:
            raise ValueError(f"its status is {str(record.status)!r}, and its run is not over")
        for name in ("num_timesteps", "measured"):
            getattr(record, name)
        if not all(isinstance(text, str) for text in measured.values()):
            raise ValueError("measured must map names of files to their texts")
        if content["evaluations"] is None:
            if record.status is Status.FINISHED:
                raise ValueError("a finished run needs evaluations")
            return cls(address, record, measured=measured)
        return cls(address, record, **_evaluations(content["evaluations"]), measured=measured)

    def line(self) -> bytes:
        """Return the run as one line of JSON, newline included."""
        parts = {"timesteps": self.timesteps, "returns": self.returns, "lengths": self.lengths}
        content = {
            "address": self.address,
            "record": dict(self.record),
            "evaluations": {name: _short(part.tolist()) for name, part in parts.items()}
            if len(self.timesteps)
            else None,
            "measured": self.measured,
        }
        return json.dumps(content, separators=(",", ":")).encode() + b"\n"

    def covers(self, other: Archived) -> bool:
        """Whether this is the same run and has every measurement of the other."""
        here, there = self.record.measured, other.record.measured
        return self.address == other.address and {**here, **there} == here


class Archive:
    """A JSON-lines file with one run per line, which processes may read and append to at once.

    Example::

        from pathlib import Path
        from sb3_sparse.zoo import Archive, RunFolder, RunSpec, train
        from sb3_sparse.zoo.archive import Archived

        outcome = train(RunSpec(n_timesteps=200, eval_freq=100, eval_episodes=1))
        archive = Archive(Path("runs.jsonl"))
        archive.add([Archived.of_folder(RunFolder(outcome.folder), "my-run")])
        (run,) = archive.read()["my-run"]
        print(run.record["total"]["sparsity"], run.returns.mean(axis=1))

    :param path: the file; it need not exist yet
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> Lines:
        """Read and check all lines; skip a last line that was cut off while being written.

        :raises ConfigError: if the file cannot be opened
        :raises CorruptStateError: if a line is damaged
        """
        with (
            reading(self.path, "archive of runs", "study run --archive makes one"),
            self.path.open("rb") as file,
            _locked(file, alone=False),
        ):
            content = file.read()
        whole, rest = self._parsed(content)
        if rest:
            warn(
                f"the last line of {self.path} was cut off while being written and is skipped; "
                "study run --archive repairs the file"
            )
        return whole

    def add(self, runs: Iterable[Archived]) -> None:
        """Append the runs that the archive lacks, as complete lines that are synced to disk.

        A partial line left by a killed process is removed; its run's folder still has the data.

        :raises CorruptStateError: if a line is damaged; nothing is written then
        :raises Unwritable: if the file cannot be written; it is left unchanged
        """
        cure = "free space or make it writable, then repeat the command; no run is lost"
        with writing(self.path.parent, cure):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a+b", buffering=0) as file, _locked(file, alone=True):
                file.seek(0)
                content = file.read()
                known, rest = self._parsed(content)
                text = b"".join(one.line() for one in runs if not _has(known, one))
                whole = content.removesuffix(rest)
                if text and whole and not whole.endswith(b"\n"):
                    text = b"\n" + text
                if text or rest:
                    _write_at(file, len(whole), text)

    def _parsed(self, content: bytes) -> tuple[Lines, bytes]:
        """Return the lines by address, and any partial line that a killed process left."""
        *lines, rest = content.split(b"\n")
        if rest and _is_whole(rest):
            lines, rest = [*lines, rest], b""
        if rest and not (rest.startswith(BEGINNING) or BEGINNING.startswith(rest)):
            lines, rest = [*lines, rest], b""  # not the start of a line: damaged
        found: dict[str, list[Archived]] = {}
        for number, line in enumerate(lines, start=1):
            if line.strip():
                source = Path(f"{self.path}, line {number}")
                with reading(source, WHAT, CURE):
                    one = Archived.of_line(line, source)
                found.setdefault(one.address, []).append(one)
        return found, rest


def _write_at(file: IO[bytes], end: int, text: bytes) -> None:
    """Replace everything after ``end`` with a text, complete and synced, or not at all."""
    left = memoryview(text)
    try:
        file.truncate(end)
        while left:
            left = left[file.write(left) :]
        os.fsync(file.fileno())
    except BaseException:
        file.truncate(end)
        raise


def _has(known: Lines, run: Archived) -> bool:
    return any(one.covers(run) for one in known.get(run.address, ()))


def _is_whole(line: bytes) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def _evaluations(given: Mapping[str, Any]) -> dict[str, Array]:
    """Return the evaluations as arrays of matching shapes.

    :raises ValueError: if the shapes do not match, or a number is not finite
    """
    names = ("timesteps", "returns", "lengths")
    found = {name: np.asarray(given[name], np.float64) for name in names}
    timesteps, returns, lengths = found.values()
    if returns.ndim != 2 or returns.size == 0 or timesteps.shape != returns.shape[:1]:
        raise ValueError(f"returns of shape {returns.shape} at steps of shape {timesteps.shape}")
    if lengths.shape != returns.shape:
        raise ValueError(f"lengths of shape {lengths.shape}, returns of shape {returns.shape}")
    if not all(np.isfinite(one).all() for one in found.values()):
        raise ValueError("its evaluations are not finite")
    return found


def _short(value: Any) -> Any:
    """Round numbers, and make whole ones integers, so that they take little space."""
    if isinstance(value, list):
        return [_short(one) for one in value]
    return int(value) if value == int(value) else round(value, DECIMALS)


@contextmanager
def _locked(file: IO[bytes], alone: bool) -> Iterator[None]:
    """Keep other processes from writing and, if ``alone``, from reading."""
    if sys.platform == "win32":
        import msvcrt

        def hold(mode: int) -> None:
            file.seek(2**31 - 2)  # beyond all lines: nobody can read a locked byte
            msvcrt.locking(file.fileno(), mode, 1)
            file.seek(0)

        hold(msvcrt.LK_LOCK)
        try:
            yield
        finally:
            hold(msvcrt.LK_UNLCK)
        return
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
    try:
        yield
    finally:
        fcntl.flock(file, fcntl.LOCK_UN)
