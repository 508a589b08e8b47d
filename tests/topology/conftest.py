"""A layer that is nothing but two arrays, and moments with defaults."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sb3_sparse.topology import Exchange, MaskUpdate


@dataclass(frozen=True)
class ArrayLayer:
    """A layer by its flat weights and the set of its active connections."""

    weights: tuple[float, ...]
    active: frozenset[int]
    initial_nnz: int
    final_nnz: int
    name: str = "actor.mu"

    @property
    def size(self) -> int:
        return len(self.weights)

    @property
    def nnz(self) -> int:
        return len(self.active)

    def mask(self) -> np.ndarray:
        return np.array([index in self.active for index in range(self.size)], dtype=np.bool_)

    def dense(self) -> np.ndarray:
        weights = np.where(self.mask(), np.array(self.weights, np.float32), np.float32(0))
        weights.setflags(write=False)  # a method may look only
        return weights

    def after(self, exchange: Exchange) -> ArrayLayer:
        """The layer that an exchange leaves; fails on one that is not possible."""
        dropped, grown = exchange.dropped.tolist(), exchange.grown.tolist()
        assert dropped == sorted(set(dropped))
        assert grown == sorted(set(grown))
        assert self.active.issuperset(dropped)
        assert self.active.isdisjoint(grown)
        assert all(0 <= index < self.size for index in grown)
        return replace(self, active=(self.active - set(dropped)) | set(grown))


@pytest.fixture(scope="session")
def make_layer():
    """Maker of layers; active is what differs from 0 unless given."""

    def make(weights, active=None, initial_nnz=None, final_nnz=None, name="actor.mu"):
        flat = tuple(float(value) for value in np.ravel(weights))
        if active is None:
            active = [index for index, value in enumerate(flat) if value != 0]
        nnz = len(set(active))
        return ArrayLayer(
            flat,
            frozenset(active),
            nnz if initial_nnz is None else initial_nnz,
            nnz if final_nnz is None else final_nnz,
            name,
        )

    return make


@pytest.fixture(scope="session")
def make_update():
    """Maker of mask updates, at the start of training unless said otherwise."""

    def make(progress=0.0, drop_fraction=0.5, step=1000, begin=0.0, end=0.8, seed=0):
        return MaskUpdate(
            step=step,
            progress=progress,
            begin=begin,
            end=end,
            drop_fraction=drop_fraction,
            seed=seed,
        )

    return make


@pytest.fixture(scope="session")
def three_by_four(make_layer):
    """Six of twelve connections; by magnitude 2, 11, 8, 0, 7, 5."""
    return make_layer([[0.5, 0, -0.1, 0], [0, 0.9, 0, -0.7], [0.3, 0, 0, 0.2]])
