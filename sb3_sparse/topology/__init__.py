"""How masks move: one file and one registration for each method."""

from sb3_sparse.topology import granet, prune, rigl, set, static  # noqa: A004, F401
from sb3_sparse.topology.base import (
    NOTHING,
    Array,
    DropGrow,
    Exchange,
    Layer,
    MaskUpdate,
    TopologyMethod,
)
from sb3_sparse.topology.methods import Methods
from sb3_sparse.topology.registry import method_named, method_names, register

__all__ = [
    "NOTHING",
    "Array",
    "DropGrow",
    "Exchange",
    "Layer",
    "MaskUpdate",
    "Methods",
    "TopologyMethod",
    "method_named",
    "method_names",
    "register",
]
