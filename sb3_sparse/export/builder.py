"""Operations collected one after another, by whatever walks through a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from torch import nn

from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export.activations import NAMES
from sb3_sparse.export.nodes import Concat, Flatten, Node, Slice

ALLOWED = (
    f"Linear, Conv2d, MaxPool2d, Flatten, BatchNorm, LayerNorm, Dropout, {NAMES}, and modules "
    "whose forward does nothing but call these, add, multiply, square, flatten and concatenate"
)


@dataclass
class GraphBuilder:
    """Collects operations, numbers their results, and knows the shape of each.

    :param observation_shape: shape of one observation, which is value 0
    :param names: names of the policy's modules, by ``id``
    """

    observation_shape: tuple[int, ...]
    names: Mapping[int, str] = field(default_factory=dict)
    nodes: list[Node] = field(default_factory=list)
    changed: set[int] = field(default_factory=set)
    """Values that torch changes in place."""

    def shape_of(self, value: int) -> tuple[int, ...]:
        """Return the shape of a value."""
        return self.nodes[value - 1].shape if value else self.observation_shape

    def add(self, node: Node) -> int:
        """Append an operation and return the number of its result."""
        self.nodes.append(node)
        return len(self.nodes)

    def concat(self, values: list[int]) -> int:
        """Concatenate values; all parts of the observation together are the observation."""
        shapes = [self.shape_of(value) for value in values]
        if len(values) == 1:
            return values[0]
        start = 0
        for value in values:
            source = self.sources(value)[-1]
            node = self.nodes[source - 1] if source else None
            if not isinstance(node, Slice) or node.start != start:
                start = -1
                break
            start += int(np.prod(node.shape))
        if (start,) == self.observation_shape and all(len(shape) == 1 for shape in shapes):
            return 0
        units = sum(shape[0] for shape in shapes)
        return self.add(Concat(tuple(values), (units, *shapes[0][1:])))

    def finish(self) -> tuple[Node, ...]:
        """Return all operations.

        :raises UnsupportedError: if a value is changed in place and used elsewhere, too
        """
        for value in self.changed:
            if sum(value in node.inputs for node in self.nodes) > 1:
                raise UnsupportedError(
                    "a network that changes a value in place (inplace=True, +=) and uses it "
                    "elsewhere too cannot be exported; build it with inplace=False"
                )
        return tuple(self.nodes)

    def sources(self, value: int) -> list[int]:
        """Return a value, followed by the values that it is a view of."""
        found = [value]
        while found[-1] and isinstance(node := self.nodes[found[-1] - 1], Flatten):
            found.append(node.inputs[0])
        return found

    def unsupported(
        self, module: nn.Module, why: str = "", allowed: str = ALLOWED
    ) -> UnsupportedError:
        """Return the error for a module that cannot be exported."""
        kind, name = type(module).__name__, self.names.get(id(module), "")
        called = f"{name} ({kind})" if name else kind
        reason = f": {why}" if why else ""
        return UnsupportedError(f"{called} cannot be exported{reason}; allowed are {allowed}")
