from __future__ import annotations

import pytest
import torch as th
from torch import nn

from sb3_sparse.engine.optimizers import check_weight_decay, keep_implementation, rebuild
from sb3_sparse.errors import ConfigError


@pytest.fixture
def net() -> nn.Linear:
    return nn.Linear(3, 2)


def test_adam_is_fused_by_default_and_keeps_its_other_settings(net):
    kwargs = dict(betas=(0.5, 0.999), eps=1e-5)
    optimizer = rebuild(th.optim.Adam(net.parameters(), lr=0.1, **kwargs), kwargs)
    assert optimizer.defaults["fused"] is True
    assert optimizer.defaults["betas"] == (0.5, 0.999)
    assert optimizer.defaults["eps"] == 1e-5
    assert optimizer.defaults["lr"] == 0.1


@pytest.mark.parametrize("choice", [dict(fused=False), dict(foreach=True)])
def test_the_users_choice_of_implementation_stands(net, choice):
    original = th.optim.Adam(net.parameters(), lr=0.1, **choice)
    assert rebuild(original, choice) is original


def test_other_optimizers_stay_as_they_are(net):
    original = th.optim.RMSprop(net.parameters(), lr=0.1)
    assert rebuild(original, {}) is original


def test_a_state_saved_by_an_eager_optimizer_leaves_a_fused_one_fused(net):
    eager = th.optim.Adam(net.parameters(), lr=0.1)
    net(th.ones(1, 3)).sum().backward()
    eager.step()
    fused = rebuild(th.optim.Adam(net.parameters(), lr=0.1), {})
    fused.register_load_state_dict_pre_hook(keep_implementation)
    fused.load_state_dict(eager.state_dict())
    assert fused.param_groups[0]["fused"] is True
    moments = eager.state[net.weight]["exp_avg"]
    assert th.equal(fused.state[net.weight]["exp_avg"], moments)
    fused.step()


@pytest.mark.parametrize("wrong", [-1e-4, float("inf"), float("nan"), "small", True])
def test_a_weight_decay_that_is_none_is_refused(wrong):
    with pytest.raises(ConfigError, match="0 or more"):
        check_weight_decay(wrong, None)


def test_weight_decay_given_twice_is_refused():
    with pytest.raises(ConfigError, match="given twice"):
        check_weight_decay(1e-4, dict(weight_decay=1e-3))
