"""Looking into a saved model."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from stable_baselines3.common.save_util import load_from_zip_file

from sb3_sparse.errors import ConfigError
from sb3_sparse.policies.mixin import SparsePolicyMixin
from sb3_sparse.policies.report import SparsityReport


def load_sparse_policy(path: Path) -> SparsePolicyMixin:
    """The sparse policy in a zip that SB3 saved, whichever algorithm trained it.

    :raises ConfigError: if there is no such file, or no sparse policy in it
    """
    if not path.suffix and path.with_suffix(".zip").is_file():
        path = path.with_suffix(".zip")  # as SB3 does
    if not path.is_file():
        raise ConfigError(f"there is no file {path}; give a model saved by SB3, e.g. model.zip")
    try:
        data, params, _ = load_from_zip_file(path, device="cpu")
    except (BadZipFile, ValueError) as error:
        raise ConfigError(f"{path} is no model saved by SB3: {error}") from error
    policy_class = (data or {}).get("policy_class")
    if not (isinstance(policy_class, type) and issubclass(policy_class, SparsePolicyMixin)):
        name = getattr(policy_class, "__name__", "none")
        raise ConfigError(f"the policy in {path} is not sparse but {name}")
    assert data is not None
    assert params is not None
    kwargs = dict(data["policy_kwargs"])
    if data["use_sde"]:
        kwargs["use_sde"] = True
    policy = policy_class(
        data["observation_space"], data["action_space"], policy_class._dummy_schedule, **kwargs
    )
    state: Any = params["policy"]
    policy.load_state_dict(state)
    return policy


def inspect_model(path: Path) -> SparsityReport:
    """The sparsity report of a saved model."""
    return load_sparse_policy(path).sparsity_report()
