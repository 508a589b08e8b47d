"""Policies that torch compiled."""

import torch as th
from support import make

from sb3_sparse.policies.compiled import unwrapped


def test_a_compiled_policy_is_unwrapped_and_any_other_is_itself():
    policy = make("PPO").policy
    compiled = th.compile(policy, backend="eager")
    assert type(compiled) is not type(policy)
    assert unwrapped(compiled) is policy
    assert unwrapped(policy) is policy
