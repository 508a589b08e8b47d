"""A deterministic policy as a list of operations, from which most formats are written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.nodes import Argmax, Node, Positive, Weighted


@dataclass(frozen=True)
class Part:
    """A part of a dict observation.

    :param key: the part's key
    :param shape: shape as the policy sees it (images channels first), ``()`` for a single number
    :param pixels: whether it is a uint8 image
    """

    key: str
    shape: tuple[int, ...]
    pixels: bool

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape))


@dataclass(frozen=True, eq=False)
class Graph:
    """A policy: from one observation to its action.

    :param observation_shape: shape of one observation as the policy sees it (images channels
        first); a dict is one row that concatenates its parts
    :param nodes: operations in execution order; the last result is the action
    :param action_shape: shape of one action
    :param images: whether observations are uint8 images
    :param parts: the parts of a dict observation
    """

    observation_shape: tuple[int, ...]
    nodes: tuple[Node, ...] = field(default=())
    action_shape: tuple[int, ...] = ()
    images: bool = False
    parts: tuple[Part, ...] = ()

    @property
    def discrete(self) -> bool:
        """Whether actions are whole numbers."""
        return isinstance(self.nodes[-1], (Argmax, Positive))

    @property
    def layers(self) -> list[Weighted]:
        """All layers with connections."""
        return [node for node in self.nodes if isinstance(node, Weighted)]

    @property
    def nnz(self) -> int:
        """Number of connections that are not 0."""
        return sum(node.nnz for node in self.nodes)

    def shape_of(self, value: int) -> tuple[int, ...]:
        """Return the shape of a value; value 0 is the observation."""
        return self.nodes[value - 1].shape if value else self.observation_shape

    def users(self, value: int) -> list[Node]:
        """Return the nodes that read a value."""
        return [node for node in self.nodes if value in node.inputs]

    def rows(self, observations: Any) -> NDArray[np.float32]:
        """Convert a batch of observations, which may be a dict, to the shape of value 0."""
        if self.parts:
            rows = [np.reshape(observations[p.key], (-1, p.size)) for p in self.parts]
            observations = np.concatenate([row.astype(np.float32) for row in rows], axis=1)
        return np.asarray(observations, np.float32).reshape(-1, *self.observation_shape)

    def values(self, observations: Any) -> list[NDArray[Any]]:
        """Compute all values for a batch of observations; the batch is the last axis."""
        batch = self.rows(observations)
        values: list[NDArray[Any]] = [np.moveaxis(batch, 0, -1)]
        for node in self.nodes:
            values.append(node.run(*(values[i] for i in node.inputs)))
        return values

    def run(self, observations: Any) -> NDArray[Any]:
        """Compute the flat actions of a batch of observations, shape ``(batch, actions)``."""
        result = np.moveaxis(self.values(observations)[-1], -1, 0)
        return result.reshape(len(result), -1)
