"""``rl_zoo3.train -optimize`` keeps the policy's arguments that a config gives.

Its samplers draw a ``policy_kwargs`` of their own, which replaces the config's as a whole, so that
a sparse policy would lose its sparsity. Importing this module, as ``--gym-packages
sb3_sparse.rl_zoo_optimize`` does, puts the config's below the sampled ones; stock policies stay as
they are. Nothing else of this package imports it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any

from sb3_sparse.errors import MissingExtra

try:
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
except ImportError as error:
    raise MissingExtra("training runs", "zoo") from error

Sampler = Callable[..., dict[str, Any]]
_of_config = threading.local()  # rl-zoo's --n-jobs runs trials in threads


def keep_policy_kwargs() -> None:
    """Make rl_zoo3's samplers keep a sparse policy's arguments; once."""
    if hasattr(ExperimentManager.objective, "__wrapped__"):
        return
    noting = _noting_the_config(ExperimentManager.objective)
    setattr(ExperimentManager, "objective", noting)  # noqa: B010
    for name, sampler in HYPERPARAMS_SAMPLER.items():
        HYPERPARAMS_SAMPLER[name] = _keeping(sampler)


def _noting_the_config(objective: Callable[..., float]) -> Callable[..., float]:
    @wraps(objective)
    def noting(manager: Any, trial: Any) -> float:
        kwargs = manager._hyperparams.get("policy_kwargs") or {}
        _of_config.policy_kwargs = kwargs if "sparsity" in kwargs else {}
        return objective(manager, trial)

    return noting


def _keeping(sampler: Sampler) -> Sampler:
    @wraps(sampler)
    def keeping(*args: Any, **kwargs: Any) -> dict[str, Any]:
        sampled = sampler(*args, **kwargs)
        kept = getattr(_of_config, "policy_kwargs", {})
        if kept:
            sampled["policy_kwargs"] = {**kept, **sampled.get("policy_kwargs", {})}
        return sampled

    return keeping


keep_policy_kwargs()
