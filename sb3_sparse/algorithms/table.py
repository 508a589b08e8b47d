"""Which class trains an algorithm."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # which is imported when an algorithm is, not when one is named
    from stable_baselines3.common.base_class import BaseAlgorithm

HOMES = {"A2C": "a2c", "DDPG": "td3", "DQN": "dqn", "PPO": "ppo", "SAC": "sac", "TD3": "td3"}
"""Modules of this package by the name of the algorithm whose class they have."""


def algorithm_named(name: str) -> type[BaseAlgorithm]:
    """The class of an algorithm: this package's where it has one, else sb3-contrib's.

    :param name: one of :func:`~sb3_sparse.policies.registry.algorithm_names`
    """
    if name in HOMES:
        found: type[BaseAlgorithm] = getattr(
            import_module(f"sb3_sparse.algorithms.{HOMES[name]}"), name
        )
        return found
    from sb3_sparse.policies.registry import supported_algorithms

    return supported_algorithms()[name]


def trainer_of(algorithm: type[BaseAlgorithm]) -> type:
    """The class whose ``train()`` an algorithm runs; for this package's, SB3's that it equals.

    :param algorithm: any class of an algorithm, a user's own too
    """
    return next(
        (
            cls
            for cls in algorithm.__mro__
            if "train" in vars(cls) and not cls.__module__.startswith("sb3_sparse.algorithms.")
        ),
        algorithm,
    )
