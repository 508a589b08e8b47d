"""Writes a policy as an .npz file without pickles, for the loader in ``numpy_policy.py``."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Node, Weighted


def write_npz(graph: Graph) -> bytes:
    """Return the bytes of the file: names and inputs of all nodes, their arrays, the outputs."""
    most = max(len(node.inputs) for node in graph.nodes)
    inputs = np.zeros((len(graph.nodes), most), np.int32)
    for row, node in zip(inputs, graph.nodes, strict=True):
        row[:] = -1  # no input
        row[: len(node.inputs)] = node.inputs
    arrays: dict[str, NDArray[Any]] = {
        "ops": np.array([node.name for node in graph.nodes]),
        "inputs": inputs,
        "observation": np.array(graph.observation_shape, np.int64),
        "action": np.array(graph.action_shape, np.int64),
        "keys": np.array([part.key for part in graph.parts], np.str_),
        "axes": np.array([len(part.shape) for part in graph.parts], np.int64),
    }
    if graph.chosen:
        arrays["outputs"] = np.array([one.name for one in graph.outputs])
    for one in graph.chosen:
        arrays[f"value.{one.name}"] = np.array(one.value, np.int64)
        arrays[f"shape.{one.name}"] = np.array(one.shape, np.int64)
    for number, node in enumerate(graph.nodes):
        arrays.update({f"{number}.{name}": field for name, field in _fields(node).items()})
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def _fields(node: Node) -> dict[str, NDArray[Any]]:
    """Return a node's arrays, with the weight as compressed rows if that is smaller."""
    fields = node.fields()
    if not isinstance(node, Weighted):
        return fields
    rows = fields.pop("weight")
    row, column = np.nonzero(rows)
    index = np.dtype(np.uint16 if rows.shape[1] <= 2**16 else np.uint32)
    if len(row) * (4 + index.itemsize) >= rows.size * 4:
        return {**fields, "weight": rows}
    starts = np.searchsorted(row, np.arange(len(rows) + 1)).astype(np.int32)
    return {
        **fields,
        "data": rows[row, column],
        "columns": column.astype(index),
        "starts": starts,
        "size": np.array(rows.shape),
    }
