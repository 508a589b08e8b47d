"""A deterministic policy as a list of operations, which every format is written from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.nodes import Argmax, Node, Positive, Weighted


@dataclass(frozen=True)
class Part:
    """A part of an observation that is a dict.

    :param key: its key
    :param shape: as the policy sees it (images channels first), ``()`` of a single number
    :param pixels: whether it is an image of uint8
    """

    key: str
    shape: tuple[int, ...]
    pixels: bool

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return int(np.prod(self.shape))


@dataclass(frozen=True, eq=False)
class Graph:
    """A policy: from one observation to its action.

    :param observation_shape: of one observation, as the policy sees it (images channels first); a
        dict is one row, its parts behind each other
    :param nodes: in an order in which they can be run; the last one's result is the action
    :param action_shape: of one action
    :param images: whether observations are images of uint8
    """

    observation_shape: tuple[int, ...]
    nodes: tuple[Node, ...] = field(default=())
    action_shape: tuple[int, ...] = ()
    images: bool = False
    parts: tuple[Part, ...] = ()
    """Of observations that are dicts."""

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
        """Connections that are not 0."""
        return sum(layer.nnz for layer in self.layers)

    def shape_of(self, value: int) -> tuple[int, ...]:
        """Shape of a value; 0 is the observation."""
        return self.nodes[value - 1].shape if value else self.observation_shape

    def users(self, value: int) -> list[Node]:
        """The nodes that take a value."""
        return [node for node in self.nodes if value in node.inputs]

    def rows(self, observations: Any) -> NDArray[np.float32]:
        """A batch of observations, perhaps in a dict, as an array of the shape that it computes."""
        if self.parts:
            rows = [np.reshape(observations[p.key], (-1, p.size)) for p in self.parts]
            observations = np.concatenate([row.astype(np.float32) for row in rows], axis=1)
        return np.asarray(observations, np.float32).reshape(-1, *self.observation_shape)

    def values(self, observations: Any) -> list[NDArray[Any]]:
        """Every value for a batch of observations, the batch last."""
        batch = self.rows(observations)
        values: list[NDArray[Any]] = [np.moveaxis(batch, 0, -1)]
        for node in self.nodes:
            values.append(node.run(*(values[i] for i in node.inputs)))
        return values

    def run(self, observations: Any) -> NDArray[Any]:
        """Actions of a batch of observations, one a row, flat: shape ``(batch, actions)``."""
        result = np.moveaxis(self.values(observations)[-1], -1, 0)
        return result.reshape(len(result), -1)
