"""Describes why an export was rejected."""

from __future__ import annotations

import numpy as np

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Argmax
from sb3_sparse.export.parity import TOLERANCE, Parity


def failure_of(parity: Parity, graph: Graph | None) -> str:
    """Describe the difference, and how close the scores are, since a tie may go either way."""
    text = f"{parity} (allowed: {_allowed(parity)})"
    if graph is None or not isinstance(graph.action, Argmax):
        return text
    if parity.worst is None:
        return text
    scores = graph.values(parity.worst)[graph.action.inputs[0]][:, 0]
    parts = np.split(scores, np.cumsum(graph.action.sizes)[:-1])
    gap = min(float(np.diff(np.sort(part)[-2:])[0]) for part in parts if part.size > 1)
    return f"{text}; at one of them the two best actions are {gap:.1e} apart in score"


def _allowed(parity: Parity) -> str:
    if not parity.discrete:
        return str(TOLERANCE)
    return f"0 actions, {TOLERANCE} of further outputs" if parity.further else "0"
