"""A policy as a list of operations, from which most formats are written."""

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


@dataclass(frozen=True)
class Output:
    """A value that is written out.

    :param name: ``"action"``, ``"value"``, ``"mean"``, ``"std"`` or ``"logits"``
    :param value: number of the value
    :param shape: shape for one observation, ``()`` for a single number
    :param meaning: what a further output is, for the files' first lines
    """

    name: str
    value: int
    shape: tuple[int, ...]
    meaning: str = ""


@dataclass(frozen=True, eq=False)
class Graph:
    """A policy: from one observation to its action, and to further outputs.

    :param observation_shape: shape of one observation as the policy sees it (images channels
        first); a dict is one row that concatenates its parts
    :param nodes: operations in execution order
    :param action_shape: shape of one action
    :param images: whether observations are uint8 images
    :param parts: the parts of a dict observation
    :param chosen: the action, then the further outputs; empty: the last result is the action, and
        there are no others
    """

    observation_shape: tuple[int, ...]
    nodes: tuple[Node, ...] = field(default=())
    action_shape: tuple[int, ...] = ()
    images: bool = False
    parts: tuple[Part, ...] = ()
    chosen: tuple[Output, ...] = ()

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The action, then the further outputs."""
        return self.chosen or (Output("action", len(self.nodes), self.action_shape),)

    @property
    def sizes(self) -> dict[str, int]:
        """Number of elements of each output, by its name."""
        return {one.name: int(np.prod(self.shape_of(one.value))) for one in self.outputs}

    @property
    def action(self) -> Node:
        """The operation whose result is the action."""
        return self.nodes[self.outputs[0].value - 1]

    @property
    def discrete(self) -> bool:
        """Whether actions are whole numbers."""
        return isinstance(self.action, (Argmax, Positive))

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

    def name_of(self, value: int) -> str | None:
        """Return the name of a value that is an output; None for any other."""
        return next((output.name for output in self.outputs if output.value == value), None)

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
        """Compute all outputs of a batch of observations, side by side in a row for each."""
        return self.side_by_side(self.values(observations))

    def side_by_side(self, values: list[NDArray[Any]]) -> NDArray[Any]:
        """Return the outputs among all values, side by side in a row for each observation."""
        results = [np.moveaxis(values[output.value], -1, 0) for output in self.outputs]
        return np.concatenate([result.reshape(len(result), -1) for result in results], axis=1)
