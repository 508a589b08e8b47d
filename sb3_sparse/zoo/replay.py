"""A replay buffer on disk, where each save writes only what is new."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

ROWS = 10_000  # of one file
LARGE = ("observations", "next_observations")  # written once and never changed; all else is small
NOT_SAVED = ("device", "env")
REST = "rest.pkl"


class BufferSaver:
    """Saves a replay buffer again and again, each time into a new folder.

    Observations lie in files of 10,000 rows. A file of which no row is new is linked from the last
    folder, so a save takes time and room by what was collected since then.

    :param buffer: any replay buffer of SB3
    """

    def __init__(self, buffer: BaseBuffer) -> None:
        self.buffer = buffer
        self.last: Path | None = None
        self.position = 0
        self.rows = 0

    def save(self, folder: Path, rows: int) -> None:
        """Save everything.

        :param folder: new, and kept until the next save
        :param rows: how many rows have been added since training began
        """
        folder.mkdir(parents=True)
        buffer = self.buffer
        state = getattr(buffer, "__getstate__", lambda: vars(buffer))()
        large = dict(_large_arrays(buffer))
        rest = {k: v for k, v in state.items() if k not in NOT_SAVED and not (large and k in LARGE)}
        with (folder / REST).open("wb") as file:
            pickle.dump(rest, file, protocol=pickle.HIGHEST_PROTOCOL)
        changed = self._changed(rows)
        filled = buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)
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
        """Numbers of the files that hold a row added since the last save.

        The row at the present position counts: with ``optimize_memory_usage`` it holds the newest
        observation.
        """
        size = self.buffer.buffer_size
        added = min(rows - self.rows, size)
        return {(self.position + row) % size // ROWS for row in range(added + 1)}


def restore_buffer(buffer: BaseBuffer, folder: Path) -> None:
    """Fill a new buffer of the same kind and size with what was saved."""
    for path in folder.glob("*.npz"):
        with np.load(path) as saved:
            for key, array in _large_arrays(buffer):
                rows = saved[key]
                begin = int(path.stem) * ROWS
                array[begin : begin + len(rows)] = rows
    with (folder / REST).open("rb") as file:
        vars(buffer).update(pickle.load(file))


def end_episodes(buffer: BaseBuffer) -> None:
    """End the episodes that were under way, since what comes next does not follow on them."""
    if isinstance(buffer, HerReplayBuffer):
        buffer.truncate_last_trajectory()
    elif isinstance(buffer, ReplayBuffer) and buffer.size():
        newest = buffer.pos - 1
        if buffer.optimize_memory_usage:  # the row after it will hold another episode
            buffer.dones[newest] = 1.0
        if buffer.handle_timeout_termination:  # returns over several steps stop here
            buffer.timeouts[newest] = 1.0


def _large_arrays(buffer: BaseBuffer) -> Iterator[tuple[str, NDArray[Any]]]:
    """Names and arrays of observations, of each part of a dict for itself."""
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
