"""How masks move: one file and one registration for each method."""

from sb3_sparse.topology import prune, rigl, set, static  # noqa: A004, F401  (they register)
from sb3_sparse.topology.base import (
    NOTHING,
    Array,
    DropGrow,
    Exchange,
    Layer,
    MaskUpdate,
    TopologyMethod,
)
from sb3_sparse.topology.registry import method_named, method_names, register

__all__ = [
    "NOTHING",
    "Array",
    "DropGrow",
    "Exchange",
    "Layer",
    "MaskUpdate",
    "TopologyMethod",
    "method_named",
    "method_names",
    "register",
]
