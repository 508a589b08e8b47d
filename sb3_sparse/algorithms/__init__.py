"""Algorithms of SB3 and sb3-contrib with gradient steps that run in one call of the kernels.

Subclass one of them for an algorithm of your own (docs/gradient_steps.md).
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily

if TYPE_CHECKING:
    from sb3_sparse.algorithms.a2c import A2C
    from sb3_sparse.algorithms.crossq import CrossQ
    from sb3_sparse.algorithms.dqn import DQN
    from sb3_sparse.algorithms.ppo import PPO
    from sb3_sparse.algorithms.qrdqn import QRDQN
    from sb3_sparse.algorithms.sac import SAC
    from sb3_sparse.algorithms.td3 import DDPG, TD3
    from sb3_sparse.algorithms.tqc import TQC

__all__ = ["A2C", "DDPG", "DQN", "PPO", "SAC", "TD3"]
if find_spec("sb3_contrib"):
    __all__ += ["QRDQN", "TQC", "CrossQ"]
__getattr__, __dir__ = lazily(__name__)
