"""Sparse training for deep reinforcement learning, inside stock Stable-Baselines3.

Importing the package registers ``SparsePolicy`` with every supported algorithm. Only the command
line, which answers ``--help`` without torch, leaves that to the first module that needs it.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_sparse.lazy import lazily
from sb3_sparse.policies.registry import (
    CONTRIB,
    SparsePolicy,
    SparseSimbaPolicy,
    register_policy,
    registered,
    supported_algorithms,
)

if TYPE_CHECKING:
    from sb3_sparse.algorithms.a2c import A2C
    from sb3_sparse.algorithms.crossq import CrossQ
    from sb3_sparse.algorithms.dqn import DQN
    from sb3_sparse.algorithms.ppo import PPO
    from sb3_sparse.algorithms.qrdqn import QRDQN
    from sb3_sparse.algorithms.sac import SAC
    from sb3_sparse.algorithms.td3 import DDPG, TD3
    from sb3_sparse.algorithms.tqc import TQC
    from sb3_sparse.callback import SparsityCallback
    from sb3_sparse.callbacks.recycle import RecycleDormantCallback
    from sb3_sparse.callbacks.reset import ResetCallback
    from sb3_sparse.callbacks.robust_value import RobustValueCallback
    from sb3_sparse.compress.twin import sparsify
    from sb3_sparse.policies.actor_critic import SparseActorCriticPolicy
    from sb3_sparse.policies.base import BaseSparsePolicy
    from sb3_sparse.policies.contrib import (
        SparseCrossQPolicy,
        SparseQRDQNPolicy,
        SparseTQCPolicy,
    )
    from sb3_sparse.policies.dqn import SparseDQNPolicy
    from sb3_sparse.policies.sac import SparseSACPolicy
    from sb3_sparse.policies.spec import NetworkSpec, PassCounts
    from sb3_sparse.policies.td3 import SparseTD3Policy

__version__ = version("sb3-sparse")
__all__ = [
    "A2C",
    "DDPG",
    "DQN",
    "PPO",
    "SAC",
    "TD3",
    "BaseSparsePolicy",
    "NetworkSpec",
    "PassCounts",
    "RecycleDormantCallback",
    "ResetCallback",
    "RobustValueCallback",
    "SparseActorCriticPolicy",
    "SparseDQNPolicy",
    "SparsePolicy",
    "SparseSACPolicy",
    "SparseSimbaPolicy",
    "SparseTD3Policy",
    "SparsityCallback",
    "register_policy",
    "sparsify",
    "supported_algorithms",
]
if find_spec("sb3_contrib"):
    __all__ += ["QRDQN", "TQC", "CrossQ"]
    __all__ += ["SparseCrossQPolicy", "SparseQRDQNPolicy", "SparseTQCPolicy"]
__getattr__, __dir__ = lazily(
    __name__,
    {
        name: f"sb3_sparse has no {name} of its own: sb3_contrib.{name} takes SparsePolicy, and "
        "trains it in SB3's own gradient steps"
        for name in CONTRIB
    },
)


def _is_command_line() -> bool:
    """Whether this process is ``sb3-sparse``, or ``python -m sb3_sparse.cli``."""
    program = Path(*sys.argv[:1])  # an embedded interpreter may have none
    return program.stem == "sb3-sparse" or "sb3_sparse.cli" in sys.orig_argv


if not _is_command_line():
    registered()  # imports the policies, which register themselves
