"""Policies that torch compiled: ``model.policy = th.compile(model.policy)``."""

from __future__ import annotations

from typing import TypeVar

from torch import nn

Module = TypeVar("Module", bound=nn.Module)


def unwrapped(policy: Module) -> Module:
    """The policy itself, where ``torch.compile`` has wrapped it.

    ``torch.compile`` returns a module of a class of its own, ``OptimizedModule``, that passes
    attributes on to the policy. Whoever asks for the class of a policy asks for that of this.

    :param policy: compiled or not; parameters and hooks are the same in both
    """
    found: Module = getattr(policy, "_orig_mod", policy)
    return found
