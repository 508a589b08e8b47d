"""Rounds weights to 8-bit whole numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Floats, Weighted

LARGEST = 127
SMALLEST = 1e-30
"""Rows whose weights are all smaller become 0, since their scale would underflow."""


def quantize_rows(rows: NDArray[Any]) -> tuple[NDArray[np.int8], Floats]:
    """Return whole numbers in [-127, 127] and a scale per row: ``rows ~ numbers * scale``.

    :param rows: weights with a row for each output
    """
    most = np.abs(rows).max(axis=1, initial=0.0)
    scale = (np.where(most > SMALLEST, most, 1.0) / LARGEST).astype(np.float32)
    return np.rint(rows / scale[:, None]).astype(np.int8), scale


def quantized(graph: Graph) -> Graph:
    """Return the graph with weights rounded to 8 bits."""
    return replace(graph, nodes=tuple(_rounded(node) for node in graph.nodes))


def _rounded(node: Any) -> Any:
    if not isinstance(node, Weighted):
        return node
    numbers, scale = quantize_rows(node.rows)
    weight = (numbers * scale[:, None]).reshape(node.weight.shape)
    return replace(node, weight=weight.astype(np.float32))
