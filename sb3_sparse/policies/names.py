"""Names of the algorithms that have a sparse policy, known without importing any of them."""

from __future__ import annotations

from importlib.util import find_spec

SB3 = ("DQN", "SAC", "TD3", "DDPG", "PPO", "A2C")
CONTRIB = ("TQC", "QRDQN", "CrossQ", "TRPO")
"""From sb3-contrib."""


def algorithm_names() -> list[str]:
    """Class names of the supported algorithms that are installed."""
    return [*SB3, *(CONTRIB if find_spec("sb3_contrib") else ())]
