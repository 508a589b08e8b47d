"""Where the floats of a policy in whole numbers may differ between C and NumPy, and what that does.

A sum of floats depends on the order of its terms, a tanh on the library. So the same float may
differ in its last bits, and where it lies halfway between two whole numbers, it becomes one of them
here and the other there: a step that the layers behind it carry to the action. It tells nothing
about the export, so the policy in NumPy takes the number of the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.integers import Quantize
from sb3_sparse.export.nodes import Activation, Affine, Node, Standardize, Weighted

SUMS = (Weighted, Standardize, Affine)
"""Nodes that round several times for one result, in an order, or fused, as the compiler likes."""
EXACT = ("relu", "leaky_relu", "hardswish", "softshrink", "hardshrink", "threshold")
"""Activations that are no more than a product, a sum or a comparison."""


def inexact_quantizations(graph: Graph) -> list[int]:
    """Return the values that are quantized from floats which may differ in their last bits."""
    inexact = [False]
    for node in graph.nodes:
        taken = any(inexact[value] for value in node.inputs)
        inexact.append(_is_inexact(node) or (taken and not node.whole))
    return [
        value
        for value, node in enumerate(graph.nodes, start=1)
        if isinstance(node, Quantize) and inexact[node.inputs[0]]
    ]


def _is_inexact(node: Node) -> bool:
    return isinstance(node, SUMS) or (isinstance(node, Activation) and node.kind not in EXACT)


def adopted(
    node: Quantize, floats: NDArray[Any], other: NDArray[Any], tolerance: float
) -> NDArray[np.int64]:
    """Return the numbers of a quantization: the other's, if its floats may have been the same.

    :param floats: what is quantized, shape ``(units, batch)``
    :param other: the numbers that something else has made of it, of the same shape
    :param tolerance: allowed difference of a float, relative to the range of its unit
    """
    exact = floats.astype(np.float64) * (0.5 * node.twice[:, None].astype(np.float64))
    exact = np.clip(exact, -node.most, node.most)
    same = np.abs(other - exact) <= 0.5 + tolerance * node.most
    numbers: NDArray[np.int64] = np.where(same, other, node.run(floats))
    return numbers
