"""Records which connections have been active so far."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.errors import CorruptStateError, warn
from sb3_sparse.files import written_whole
from sb3_sparse.loading.arrays import read_arrays
from sb3_sparse.loading.guard import reading

NEVER = 2**32 - 1
"""Time of the first activity of a connection that has never been active."""


class MaskHistory:
    """Looks at masks from time to time, and records when each connection was first active.

    With a path it is saved after each look. Where a model resumes from an earlier time, later looks
    are dropped, and churn counts from the model's masks.

    :param networks: the policy's sparse networks
    :param timesteps: environment steps at the start
    :param path: ``.npz`` file; None: the record stays in memory and starts anew with each training
    """

    def __init__(
        self, networks: list[SparseNetwork], timesteps: int, path: Path | None = None
    ) -> None:
        self.networks = networks
        self.path = path
        self.first: dict[str, NDArray[np.uint32]] = {}
        self.last: dict[str, NDArray[np.bool_]] = {}
        if path is not None and timesteps and path.exists():
            self._load(path, timesteps)
            return
        if path is not None and timesteps:
            warn(f"there is no file {path}, so exploration rates count from step {timesteps} on")
        for layer in self._layers():
            self.first[layer.name] = np.full(layer.size, NEVER, np.uint32)
        self._see(timesteps)

    def _layers(self) -> list[Any]:
        return [layer for network in self.networks for layer in network.layers]

    def look(self, timesteps: int) -> dict[str, tuple[float, float]]:
        """Churn since the last look, and exploration rate, of each network.

        Both are fractions of all connections within the network's budget.
        """
        changed = {layer.name: layer.mask() != self.last[layer.name] for layer in self._layers()}
        self._see(timesteps)
        found = {}
        for network in self.networks:
            names = [layer.name for layer in network.layers]
            moved = sum(int(changed[name].sum()) for name in names)
            ever = sum(int((self.first[name] != NEVER).sum()) for name in names)
            found[network.name] = (moved / network.size, ever / network.size)
        return found

    def _see(self, timesteps: int) -> None:
        for layer in self._layers():
            mask, first = layer.mask(), self.first[layer.name]
            first[mask & (first == NEVER)] = timesteps
            self.last[layer.name] = mask
        if self.path is not None:
            self._save(timesteps)

    def _save(self, timesteps: int) -> None:
        assert self.path is not None
        arrays: dict[str, Any] = {f"first/{name}": first for name, first in self.first.items()}
        arrays |= {f"last/{name}": np.packbits(last) for name, last in self.last.items()}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(self.path) as new, new.open("wb") as file:
            np.savez_compressed(file, timesteps=np.int64(timesteps), **arrays)

    def _load(self, path: Path, timesteps: int) -> None:
        what, cure = "history of masks", "remove it, or give another path"
        saved = read_arrays(path, what, cure)
        sizes = {f"first/{layer.name}": layer.size for layer in self._layers()}
        found = {name: array.size for name, array in saved.items() if name.startswith("first/")}
        if found != sizes:
            raise CorruptStateError(f"{path} belongs to a policy with other layers; {cure}")
        with reading(path, what, cure):
            ahead = int(saved["timesteps"]) > timesteps
            for layer in self._layers():
                first = saved[f"first/{layer.name}"].astype(np.uint32)
                first[first > timesteps] = NEVER
                self.first[layer.name] = first
                bits = np.unpackbits(saved[f"last/{layer.name}"], count=layer.size)
                self.last[layer.name] = layer.mask() if ahead else bits.astype(bool)
