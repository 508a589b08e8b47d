"""Policies that torch compiled: ``model.policy = th.compile(model.policy)``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from torch import nn

from sb3_sparse.engine.internals import WRAPPED

Policy = TypeVar("Policy")
Value = TypeVar("Value")


def unwrapped(policy: Policy) -> Policy:
    """The policy itself, where ``torch.compile`` has wrapped it.

    ``torch.compile`` returns an ``OptimizedModule``, which passes attributes on to the policy but
    is not of its class.

    :param policy: compiled or not; parameters and hooks are the same in both
    """
    found: Policy = getattr(policy, "_modules", {}).get(WRAPPED, policy)
    return found


def plain_names(state: Mapping[str, Value]) -> dict[str, Value]:
    """A state_dict with the names that it has without ``torch.compile``."""
    return {_plain(name): value for name, value in state.items()}


def names_in(module: nn.Module, state: Mapping[str, Value]) -> dict[str, Value]:
    """A state_dict with a module's own names, whichever of its modules are compiled.

    :param state: with plain names
    """
    if not any(name.endswith(WRAPPED) for name, _ in module.named_modules()):
        return dict(state)
    names = {_plain(name): name for name in module.state_dict()}
    return {names.get(name, name): value for name, value in state.items()}


def _plain(name: str) -> str:
    return name.replace(f"{WRAPPED}.", "")
