"""What a topology method is: a pure function from a layer to the connections it exchanges."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.sparsity.distributions import floor_count
from sb3_sparse.sparsity.schedules import cosine_drop_fraction
from sb3_sparse.sparsity.selection import Indices, largest, least_magnitude

Array = NDArray[Any]


class Layer(Protocol):
    """What a method may know of a layer. All arrays are flat, of length ``size``."""

    @property
    def name(self) -> str:
        """Dotted name within the policy."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The weight's shape, ``(out, in, *kernel)``."""

    @property
    def size(self) -> int:
        """Connections of the dense layer."""

    @property
    def nnz(self) -> int:
        """Active connections now."""

    @property
    def initial_nnz(self) -> int:
        """Active connections that the layer starts training with."""

    @property
    def final_nnz(self) -> int:
        """Active connections that the requested sparsity leaves the layer."""

    def mask(self) -> NDArray[np.bool_]:
        """True where a connection is active; a copy, to do with as one likes."""

    def dense(self) -> NDArray[np.float32]:
        """The weights, 0 where inactive."""


@dataclass(frozen=True)
class MaskUpdate:
    """When an update happens and how far it may go.

    :param step: gradient step of the optimizer that owns the network, from 1
    :param progress: environment steps done / planned, in [0, 1]
    :param begin: progress at which updates begin
    :param end: progress at which they have ended
    :param drop_fraction: the drop fraction at the start of training
    :param seed: the policy's mask seed
    """

    step: int
    progress: float
    begin: float
    end: float
    drop_fraction: float
    seed: int


@dataclass(frozen=True)
class Exchange:
    """Connections that a layer loses and gains, as ascending flat indices without overlap."""

    dropped: Indices
    grown: Indices

    def __bool__(self) -> bool:
        return bool(self.dropped.size or self.grown.size)


NOTHING = Exchange(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


class TopologyMethod(ABC):
    """A way to move masks. Subclass it (or :class:`DropGrow`) and put ``@register`` on the class.

    The class holds no state: everything an exchange depends on is handed to :meth:`exchange`.
    """

    name: ClassVar[str]
    """What a user writes: ``SparsityCallback(name)``."""
    options: ClassVar[frozenset[str]] = frozenset({"update_interval", "begin", "end", "update_on"})
    """Arguments of the callback that mean something for this method."""
    default_begin: ClassVar[float] = 0.0
    """Progress at which updates begin unless the user says otherwise."""
    needs_gradient: ClassVar[bool] = False
    """Whether :meth:`exchange` needs the dense gradient."""
    grows: ClassVar[bool] = False
    """Whether connections may be gained."""
    reaches_final: ClassVar[bool] = False
    """Whether the method takes a denser start to the requested sparsity."""

    @abstractmethod
    def exchange(self, layer: Layer, update: MaskUpdate, *, dense_grad: Array | None) -> Exchange:
        """Decide which connections of one layer move at one update.

        :param layer: the layer, read only
        :param update: when, and how much
        :param dense_grad: gradient of the loss by every weight, active or not, shape ``(size,)``;
            None unless :attr:`needs_gradient`
        """


class DropGrow(TopologyMethod):
    """Drops the active connections of least magnitude and grows as many by a score.

    What may be grown are the inactive connections and the ones just dropped; nnz never changes.
    The number exchanged follows the cosine schedule of the drop fraction.
    """

    options = TopologyMethod.options | {"drop_fraction"}
    grows = True

    @abstractmethod
    def scores(
        self, layer: Layer, update: MaskUpdate, candidates: Indices, *, dense_grad: Array | None
    ) -> Array:
        """Score of each candidate; the largest are grown.

        :param candidates: ascending flat indices of the connections that may be grown
        :return: shape ``(len(candidates),)``
        """

    def exchange(self, layer: Layer, update: MaskUpdate, *, dense_grad: Array | None) -> Exchange:
        fraction = cosine_drop_fraction(update.progress, update.drop_fraction, update.end)
        count = floor_count(fraction * layer.nnz)
        if count == 0 or layer.nnz == layer.size:
            return NOTHING
        mask = layer.mask()
        dropped = least_magnitude(layer.dense(), np.flatnonzero(mask), count)
        mask[dropped] = False
        candidates = np.flatnonzero(~mask)
        scores = self.scores(layer, update, candidates, dense_grad=dense_grad)
        grown = candidates[largest(scores, count)]
        return Exchange(
            dropped=np.setdiff1d(dropped, grown, assume_unique=True),
            grown=np.setdiff1d(grown, dropped, assume_unique=True),
        )
