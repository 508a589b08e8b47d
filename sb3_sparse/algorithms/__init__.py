"""SB3's algorithms with gradient steps that run in one call of the kernels.

Subclass one of them for an algorithm of your own (docs/gradient_steps.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily

if TYPE_CHECKING:
    from sb3_sparse.algorithms.a2c import A2C
    from sb3_sparse.algorithms.dqn import DQN
    from sb3_sparse.algorithms.ppo import PPO
    from sb3_sparse.algorithms.sac import SAC
    from sb3_sparse.algorithms.td3 import DDPG, TD3

__all__ = ["A2C", "DDPG", "DQN", "PPO", "SAC", "TD3"]
__getattr__, __dir__ = lazily(__name__)
