"""Sparse training for deep reinforcement learning, inside stock Stable-Baselines3.

Importing the package registers ``SparsePolicy`` with every supported algorithm.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from sb3_sparse.callback import SparsityCallback
from sb3_sparse.compress.twin import sparsify
from sb3_sparse.policies.actor_critic import SparseActorCriticPolicy
from sb3_sparse.policies.aliases import SparsePolicy, register_policies, supported_algorithms
from sb3_sparse.policies.dqn import SparseDQNPolicy
from sb3_sparse.policies.sac import SparseSACPolicy
from sb3_sparse.policies.td3 import SparseTD3Policy

__version__ = version("sb3-sparse")
__all__ = [
    "SparseActorCriticPolicy",
    "SparseDQNPolicy",
    "SparsePolicy",
    "SparseSACPolicy",
    "SparseTD3Policy",
    "SparsityCallback",
    "sparsify",
    "supported_algorithms",
]
_CONTRIB = ["SparseCrossQPolicy", "SparseQRDQNPolicy", "SparseTQCPolicy"]

register_policies()
if "TQC" in supported_algorithms():  # sb3-contrib is installed
    __all__ += _CONTRIB


def __getattr__(name: str) -> Any:
    if name in _CONTRIB:
        from sb3_sparse.policies import contrib

        return getattr(contrib, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
