"""How a mask may move: one file a method, one registration each."""

from sb3_sparse.topology import prune, rigl, static
from sb3_sparse.topology import set as set_
from sb3_sparse.topology.base import DropGrow, Exchange, Layer, Moment, TopologyMethod
from sb3_sparse.topology.registry import method_named, method_names, register

__all__ = [
    "DropGrow",
    "Exchange",
    "Layer",
    "Moment",
    "TopologyMethod",
    "method_named",
    "method_names",
    "prune",
    "register",
    "rigl",
    "set_",
    "static",
]
