"""Saves a replay buffer to disk, writing only new rows each time."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sparse.errors import ConfigError
from sb3_sparse.loading.arrays import read_arrays

ROWS = 10_000  # per file
LARGE = ("observations", "next_observations")  # written once and never changed; all else is small
NOT_SAVED = ("device", "env")
REST = "rest.pkl"


class BufferSaver:
    """Saves a replay buffer repeatedly, each time into a new folder.

    Observations go into files of 10,000 rows. Files without new rows are linked from the last
    folder, so time and space of a save depend only on the rows added since then.

    :param buffer: any replay buffer of SB3
    """

    def __init__(self, buffer: BaseBuffer) -> None:
        self.buffer = buffer
        self.last: Path | None = None
        self.position = 0
        self.rows = 0

    def save(self, folder: Path, rows: int) -> None:
        """Save the whole buffer.

        :param folder: a new folder; keep it until the next save
        :param rows: number of rows added since training began
        """
        folder.mkdir(parents=True)
        buffer = self.buffer
        state = getattr(buffer, "__getstate__", lambda: vars(buffer))()
        large = dict(_large_arrays(buffer))
        rest = {k: v for k, v in state.items() if k not in NOT_SAVED and not (large and k in LARGE)}
        with (folder / REST).open("wb") as file:
            pickle.dump(rest, file, protocol=pickle.HIGHEST_PROTOCOL)
        changed = self._changed(rows)
        filled = _filled(buffer.pos, buffer.full, buffer.buffer_size)
        for number in range(-(-filled // ROWS)):
            name = f"{number}.npz"
            if self.last is None or number in changed or not (self.last / name).is_file():
                part = slice(number * ROWS, min((number + 1) * ROWS, filled))
                parts: Any = {key: array[part] for key, array in large.items()}
                np.savez(folder / name, **parts)
            else:
                _link(self.last / name, folder / name)
        self.position, self.rows = buffer.pos, rows

    def _changed(self, rows: int) -> set[int]:
        """Return the numbers of the files that hold a row added since the last save.

        The row at the current position counts: with ``optimize_memory_usage`` it holds the newest
        observation.
        """
        size = self.buffer.buffer_size
        added = min(rows - self.rows, size)
        return {(self.position + row) % size // ROWS for row in range(added + 1)}


def restore_buffer(buffer: BaseBuffer, folder: Path) -> None:
    """Fill a new buffer of the same kind and size with the saved rows.

    :raises ConfigError: if a part is missing, damaged or of another size: training would take
        the missing rows, which are zeros, for experience
    """
    rest = _read(folder, REST, _unpickled)
    for name in ("pos", "full", "buffer_size"):
        if not isinstance(rest.get(name), Integral):
            raise _lacking(folder, REST, f"has no {name!r}, or of another type")
    if rest["buffer_size"] != buffer.buffer_size:
        raise _lacking(folder, REST, f"is of {rest['buffer_size']} rows, not {buffer.buffer_size}")
    filled = _filled(rest["pos"], rest["full"], buffer.buffer_size)
    for number in range(-(-filled // ROWS)):
        begin, end = number * ROWS, min((number + 1) * ROWS, filled)
        name = f"{number}.npz"
        saved = _read(folder, name, _arrays)
        for key, array in _large_arrays(buffer):
            rows = saved.get(key)
            shape = None if rows is None else rows.shape
            if shape != array[begin:end].shape:
                wanted = f"{key!r} of shape {array[begin:end].shape}"
                raise _lacking(folder, name, f"should hold {wanted}, and holds {shape}")
            array[begin:end] = rows
    vars(buffer).update(rest)


def _filled(position: int, full: bool, size: int) -> int:
    """Return the rows in use; ``optimize_memory_usage`` uses the one at the position too."""
    return size if full else min(position + 1, size)


def _read(folder: Path, name: str, how: Callable[[Path], dict[str, Any]]) -> dict[str, Any]:
    if not (folder / name).is_file():
        raise _lacking(folder, name, "is missing")
    try:
        return how(folder / name)
    except Exception as error:  # damaged bytes make pickle raise anything
        raise _lacking(folder, name, f"is damaged ({type(error).__name__}: {error})") from error


def _unpickled(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        return dict(pickle.load(file))


def _arrays(path: Path) -> dict[str, Any]:
    return dict(read_arrays(path, "part of a replay buffer", "restore it"))


def _lacking(folder: Path, name: str, what: str) -> ConfigError:
    return ConfigError(
        f"the replay buffer in {folder} is incomplete: {name} {what}. Restore it from a copy, or "
        "delete that folder to continue with an empty buffer"
    )


def end_episodes(buffer: BaseBuffer) -> None:
    """End unfinished episodes, since the next transitions do not continue them."""
    if isinstance(buffer, HerReplayBuffer):
        buffer.truncate_last_trajectory()
    elif isinstance(buffer, ReplayBuffer) and buffer.size():
        newest = buffer.pos - 1
        if buffer.optimize_memory_usage:  # the row after it will hold another episode
            buffer.dones[newest] = 1.0
        if buffer.handle_timeout_termination:  # returns over several steps stop here
            buffer.timeouts[newest] = 1.0


def _large_arrays(buffer: BaseBuffer) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield names and arrays of observations, separately for each part of a dict."""
    for name in LARGE:
        value = getattr(buffer, name, None)
        parts = value if isinstance(value, dict) else {"": value}
        for key, array in parts.items():
            if isinstance(array, np.ndarray) and array.shape[:1] == (buffer.buffer_size,):
                yield f"{name}/{key}", array


def _link(old: Path, new: Path) -> None:
    try:
        os.link(old, new)
    except OSError:  # a file system without links
        shutil.copy(old, new)
