"""Base classes of topology methods: pure functions from a layer to the connections it exchanges."""

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
    """The view of a layer that a method gets. All arrays are flat, of length ``size``.

    Example::

        import numpy as np
        from sb3_sparse.topology import Layer

        def weakest(layer: Layer) -> int:
            return int(np.where(layer.mask(), np.abs(layer.dense()), np.inf).argmin())
    """

    name: str
    """Dotted name within the policy."""
    shape: tuple[int, ...]
    """The weight's shape, ``(out, in, *kernel)``."""
    size: int
    """Connections of the dense layer."""
    nnz: int
    """Active connections now."""
    initial_nnz: int
    """Active connections at the start of training."""
    final_nnz: int
    """Active connections at the requested sparsity."""

    def mask(self) -> NDArray[np.bool_]:
        """True where a connection is active; a copy, which may be changed."""

    def dense(self) -> NDArray[np.float32]:
        """The weights, 0 where inactive."""


@dataclass(frozen=True)
class MaskUpdate:
    """When a mask update happens, and how far it may go.

    Example::

        from sb3_sparse.topology import MaskUpdate

        MaskUpdate(step=1000, progress=0.25, begin=0.0, end=1.0, drop_fraction=0.5, seed=0)

    :param step: gradient step of the optimizer that owns the network, from 1
    :param progress: environment steps done / planned, in [0, 1]
    :param begin: progress at which updates begin
    :param end: progress at which updates end
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
    """Connections that a layer loses and gains, as ascending flat indices without overlap.

    Example::

        import numpy as np
        from sb3_sparse.topology import Exchange

        Exchange(dropped=np.array([3, 7]), grown=np.array([0, 12]))
    """

    dropped: Indices
    grown: Indices

    def __bool__(self) -> bool:
        return bool(self.dropped.size or self.grown.size)


NOTHING = Exchange(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))


class TopologyMethod(ABC):
    """Base class of methods that move masks. Put ``@register`` on each subclass.

    A method holds no state: :meth:`exchange` receives everything that it may depend on. Use
    :class:`DropGrow` for methods that drop by magnitude and grow by a score.

    Example::

        import numpy as np
        from sb3_sparse.topology import NOTHING, Exchange, TopologyMethod, register

        @register
        class DropLast(TopologyMethod):
            name = "drop-last"

            def exchange(self, layer, update, *, dense_grad):
                if layer.nnz <= layer.final_nnz:
                    return NOTHING
                last = np.flatnonzero(layer.mask())[-1:]
                return Exchange(dropped=last, grown=last[:0])
    """

    name: ClassVar[str]
    """The name that users pass: ``SparsityCallback(name)``."""
    options: ClassVar[frozenset[str]] = frozenset({"update_interval", "begin", "end", "update_on"})
    """Arguments of the callback that this method uses."""
    default_begin: ClassVar[float] = 0.0
    """Progress at which updates begin by default."""
    needs_gradient: ClassVar[bool] = False
    """Whether :meth:`exchange` needs the dense gradient."""
    grows: ClassVar[bool] = False
    """Whether connections may be gained."""
    reaches_final: ClassVar[bool] = False
    """Whether the method prunes a policy that starts denser to the requested sparsity."""
    initial_share: ClassVar[float] = 0.0
    """Where :attr:`reaches_final`: the share of the sparsity that training usually starts with."""

    def initial_sparsity(self, sparsity: float) -> float:
        """Return the sparsity that training usually starts with.

        :param sparsity: the one that it ends with
        """
        return round(self.initial_share * sparsity, 9) if self.reaches_final else sparsity

    @abstractmethod
    def exchange(self, layer: Layer, update: MaskUpdate, *, dense_grad: Array | None) -> Exchange:
        """Choose the connections of one layer that move at one update.

        :param layer: the layer, read only
        :param update: time and extent of the update
        :param dense_grad: gradient of the loss by every weight, active or not, shape ``(size,)``;
            None unless :attr:`needs_gradient` is True, and at the last update of a method that
            :attr:`reaches_final`, if training ends before another gradient arrives
        """


class DropGrow(TopologyMethod):
    """Drops the active connections of least magnitude and grows others by a score.

    Candidates for growth are the inactive connections and those just dropped. By default as many
    grow as are dropped, so nnz never changes, and the drop fraction follows its cosine schedule.

    Example::

        from sb3_sparse.topology import DropGrow, register

        @register
        class GrowFirst(DropGrow):
            name = "grow-first"

            def scores(self, layer, update, candidates, *, dense_grad):
                return -candidates
    """

    options = TopologyMethod.options | {"drop_fraction"}
    grows = True

    @abstractmethod
    def scores(
        self, layer: Layer, update: MaskUpdate, candidates: Indices, *, dense_grad: Array | None
    ) -> Array:
        """Score each candidate; those with the largest scores grow.

        :param layer: the layer, read only
        :param update: time and extent of the update
        :param candidates: ascending flat indices of the connections that may grow
        :param dense_grad: as in :meth:`exchange`
        :return: shape ``(len(candidates),)``
        """

    def counts(self, layer: Layer, update: MaskUpdate) -> tuple[int, int]:
        """Return how many connections are dropped, and how many of the candidates then grow.

        :param layer: the layer, read only
        :param update: time and extent of the update
        """
        fraction = cosine_drop_fraction(update.progress, update.drop_fraction, update.end)
        count = floor_count(fraction * layer.nnz)
        return count, count

    def exchange(self, layer: Layer, update: MaskUpdate, *, dense_grad: Array | None) -> Exchange:
        drops, grows = self.counts(layer, update)
        full = layer.nnz == layer.size
        if drops == grows and (drops == 0 or full):  # a full layer can only regrow what it drops
            return NOTHING
        mask = layer.mask()
        dropped = least_magnitude(layer.dense(), np.flatnonzero(mask), drops)
        mask[dropped] = False
        grown = np.empty(0, dtype=np.int64)
        if grows:
            candidates = np.flatnonzero(~mask)
            scores = self.scores(layer, update, candidates, dense_grad=dense_grad)
            grown = candidates[largest(scores, min(grows, candidates.size))]
        return Exchange(
            dropped=np.setdiff1d(dropped, grown, assume_unique=True),
            grown=np.setdiff1d(grown, dropped, assume_unique=True),
        )
