from __future__ import annotations

import pytest
import torch as th
from torch import nn

from sb3_sparse.engine.optimizers import check_weight_decay, rebuild
from sb3_sparse.errors import ConfigError


@pytest.fixture
def net() -> nn.Linear:
    return nn.Linear(3, 2)


def test_adam_is_fused_by_default_and_keeps_its_other_settings(net):
    kwargs = dict(betas=(0.5, 0.999), eps=1e-5)
    optimizer = rebuild(th.optim.Adam(net.parameters(), lr=0.1, **kwargs), kwargs, [], 0.0)
    assert optimizer.defaults["fused"] is True
    assert optimizer.defaults["betas"] == (0.5, 0.999)
    assert optimizer.defaults["eps"] == 1e-5
    assert optimizer.defaults["lr"] == 0.1


@pytest.mark.parametrize("choice", [dict(fused=False), dict(foreach=True)])
def test_the_users_choice_of_implementation_stands(net, choice):
    original = th.optim.Adam(net.parameters(), lr=0.1, **choice)
    assert rebuild(original, choice, [], 0.0) is original


def test_other_optimizers_stay_as_they_are(net):
    original = th.optim.RMSprop(net.parameters(), lr=0.1)
    assert rebuild(original, {}, [], 0.0) is original


def test_weight_decay_is_coupled_and_on_kernels_only(net):
    original = th.optim.SGD(net.parameters(), lr=1.0)
    optimizer = rebuild(original, {}, [net.weight], 0.25)
    with th.no_grad():
        net.weight.fill_(2.0)
        net.bias.fill_(2.0)
    for parameter in net.parameters():
        parameter.grad = th.ones_like(parameter)
    optimizer.step()
    # weight: 2 - (1 + 0.25 * 2); bias: 2 - 1
    assert (net.weight == 0.5).all()
    assert (net.bias == 1.0).all()


@pytest.mark.parametrize("wrong", [-1e-4, float("inf"), float("nan"), "small", True])
def test_a_weight_decay_that_is_none_is_refused(wrong):
    with pytest.raises(ConfigError, match="0 or more"):
        check_weight_decay(wrong, None)


def test_weight_decay_given_twice_is_refused():
    with pytest.raises(ConfigError, match="given twice"):
        check_weight_decay(1e-4, dict(weight_decay=1e-3))
