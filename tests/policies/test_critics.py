from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
import torch as th
from support import make

import sb3_sparse.policies.critics as critics
from sb3_sparse import SparsityCallback


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("name", ["SAC", "TD3", "DDPG", "TQC", "CrossQ"])
def test_thirty_updates_are_bit_for_bit_those_with_the_unused_gradients(name, compute, monkeypatch):
    found = []
    for skipping in (True, False):
        if not skipping:
            monkeypatch.setattr(critics, "_frozen", lambda critic: nullcontext())
        model = make(name, policy_kwargs=dict(compute=compute))
        model.learn(50, callback=SparsityCallback("rigl", update_interval=7))
        assert model._n_updates == 30
        found.append({**model.policy.state_dict()})
    for key, value in found[0].items():
        np.testing.assert_array_equal(value, found[1][key], err_msg=key)


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("name", ["SAC", "TD3", "TQC", "CrossQ"])
def test_the_actors_loss_leaves_the_critics_without_gradients(name, compute):
    model = make(name, policy_kwargs=dict(compute=compute))
    critic = model.policy.critic
    observations = th.randn(6, 3)
    actions = th.randn(6, 1, requires_grad=True)
    q_values = critic(observations, actions)
    sum(q.sum() for q in q_values).backward() if isinstance(q_values, tuple) else (
        q_values.sum().backward()
    )
    assert actions.grad.abs().sum() > 0
    assert all(p.grad is None for p in critic.parameters())
    assert all(p.requires_grad for p in critic.parameters())


def test_the_critics_own_loss_and_a_failing_pass_leave_everything_trainable():
    critic = make("TD3").policy.critic
    critic.q1_forward(th.randn(6, 3), th.randn(6, 1)).sum().backward()
    assert any(p.grad is not None for p in critic.parameters())
    with pytest.raises(RuntimeError):
        critic(th.randn(6, 3), th.randn(5, 1, requires_grad=True))
    with pytest.raises(RuntimeError):
        critic.q1_forward(th.randn(6, 3), th.randn(5, 1, requires_grad=True))
    assert all(p.requires_grad for p in critic.parameters())
