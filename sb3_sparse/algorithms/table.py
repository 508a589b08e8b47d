"""The classes that train each algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:  # imported when an algorithm is, not when one is named
    from stable_baselines3.common.base_class import BaseAlgorithm

T = TypeVar("T")


def algorithm_named(name: str) -> type[BaseAlgorithm]:
    """Find the class of an algorithm: this package's if it has one, else sb3-contrib's.

    :param name: one of :func:`~sb3_sparse.policies.registry.algorithm_names`
    """
    own = import_module("sb3_sparse.algorithms")
    if name in own.__all__:
        found: type[BaseAlgorithm] = getattr(own, name)
        return found
    from sb3_sparse.policies.registry import supported_algorithms

    return supported_algorithms()[name]


def trainer_of(algorithm: type[BaseAlgorithm]) -> type:
    """Find the class that defines an algorithm's ``train()``; for this package's, SB3's class.

    :param algorithm: any algorithm class, including a user's own
    """
    return next(
        (
            cls
            for cls in algorithm.__mro__
            if "train" in vars(cls) and not cls.__module__.startswith("sb3_sparse.algorithms.")
        ),
        algorithm,
    )


def nearest(algorithm: type[BaseAlgorithm], known: Mapping[type, T]) -> T | None:
    """Find the entry of an algorithm, or of the nearest base class with the same ``train()``.

    :param algorithm: any algorithm class, including a user's own
    :param known: entries by algorithm class
    """
    trainer = trainer_of(algorithm)
    for cls in algorithm.__mro__:
        if cls in known:
            return known[cls]
        if cls is trainer:
            break
    return None
