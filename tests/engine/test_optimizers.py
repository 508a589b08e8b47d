from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from torch import nn

from sb3_sparse.engine.optimizers import (
    acts_elementwise,
    check_weight_decay,
    keep_implementation,
    prefer_fused,
)
from sb3_sparse.errors import ConfigError


@pytest.fixture
def net() -> nn.Linear:
    return nn.Linear(3, 2)


def test_adam_is_fused_by_default_and_keeps_every_group_and_setting(net):
    groups = [{"params": [net.weight], "lr": 0.5}, {"params": [net.bias], "betas": (0.1, 0.2)}]
    optimizer = th.optim.Adam(groups, lr=0.1, betas=(0.5, 0.999), eps=1e-5, amsgrad=True)
    before = [dict(group) for group in optimizer.param_groups]
    prefer_fused(optimizer)
    for group, old in zip(optimizer.param_groups, before, strict=True):
        assert group == {**old, "fused": True}
    assert optimizer.defaults["fused"] is True
    assert optimizer.defaults["betas"] == (0.5, 0.999)
    net(th.ones(1, 3)).sum().backward()
    start = net.weight.detach().clone()
    optimizer.step()
    # The first step of Adam is lr * g / (|g| + eps), and each gradient is 1.
    np.testing.assert_allclose(net.weight.detach(), start - 0.5 / (1 + 1e-5), atol=1e-6)
    assert "max_exp_avg_sq" in optimizer.state[net.weight]


@pytest.mark.parametrize("choice", [dict(fused=False), dict(foreach=True), dict(capturable=True)])
def test_the_users_choice_of_implementation_stands(net, choice):
    optimizer = th.optim.Adam(net.parameters(), lr=0.1, **choice)
    before = dict(optimizer.param_groups[0])
    prefer_fused(optimizer)
    assert optimizer.param_groups[0] == before


def test_other_optimizers_stay_as_they_are(net):
    optimizer = th.optim.RMSprop(net.parameters(), lr=0.1)
    before = dict(optimizer.param_groups[0])
    prefer_fused(optimizer)
    assert optimizer.param_groups[0] == before


def test_a_state_saved_by_an_eager_optimizer_leaves_a_fused_one_fused(net):
    eager = th.optim.Adam(net.parameters(), lr=0.1)
    net(th.ones(1, 3)).sum().backward()
    eager.step()
    fused = th.optim.Adam(net.parameters(), lr=0.1)
    prefer_fused(fused)
    fused.register_load_state_dict_pre_hook(keep_implementation)
    fused.load_state_dict(eager.state_dict())
    assert fused.param_groups[0]["fused"] is True
    moments = eager.state[net.weight]["exp_avg"]
    assert th.equal(fused.state[net.weight]["exp_avg"], moments)
    fused.step()


class Noisy(th.optim.SGD):
    """Langevin dynamics: SGD with noise on every weight."""

    def step(self, closure=None):
        super().step(closure)
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.data.add_(th.randn_like(parameter), alpha=1e-3)


class Shrinking(th.optim.SGD):
    """Moves weights by the gradient over its root mean square."""

    def step(self, closure=None):
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad.div_(parameter.grad.square().mean().sqrt())
        super().step(closure)


@pytest.mark.parametrize(
    ("optimizer", "elementwise"),
    [
        (th.optim.Adam, True),
        (th.optim.AdamW, True),
        (th.optim.RMSprop, True),
        (RMSpropTFLike, True),
        (partial(th.optim.SGD, momentum=0.9, weight_decay=0.1), True),
        (th.optim.NAdam, True),
        (th.optim.Adafactor, False),
        (th.optim.LBFGS, False),
        (Noisy, False),
        (Shrinking, False),
    ],
)
def test_whether_an_optimizer_acts_on_each_weight_by_itself_is_found_by_trial(
    net, optimizer, elementwise
):
    made = optimizer(net.parameters(), lr=0.0)  # which SB3's schedules may begin with
    before = th.get_rng_state()
    assert acts_elementwise(made) is elementwise
    assert not made.state
    assert th.equal(before, th.get_rng_state())


@pytest.mark.parametrize("wrong", [-1e-4, float("inf"), float("nan"), "small", True])
def test_a_weight_decay_that_is_none_is_rejected(wrong):
    with pytest.raises(ConfigError, match="0 or more"):
        check_weight_decay(wrong, None)


def test_weight_decay_given_twice_is_rejected():
    with pytest.raises(ConfigError, match="given twice"):
        check_weight_decay(1e-4, dict(weight_decay=1e-3))
