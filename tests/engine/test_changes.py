"""Changes of modules that are noticed, and those that do not count."""

from __future__ import annotations

import pytest
import torch as th
from torch import nn
from torch.nn.utils import parametrizations, prune

from sb3_sparse.engine.changes import ChangeDetector


@pytest.fixture
def network() -> nn.Sequential:
    return nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 2), nn.BatchNorm1d(2))


def test_new_numbers_do_not_count(network):
    changes = ChangeDetector(network.modules())
    with th.no_grad():
        network[0].weight.mul_(2)
    network.train(False)
    network(th.randn(3, 3))
    assert changes.unchanged()


@pytest.mark.parametrize(
    "change",
    [
        lambda n: n.__setitem__(1, nn.ReLU()),
        lambda n: n.append(nn.ReLU()),
        lambda n: n.__delitem__(1),
        lambda n: n[0].add_module("inner", nn.Identity()),
        lambda n: setattr(n[0], "weight", nn.Parameter(n[0].weight.detach().clone())),
        lambda n: n[1].register_buffer("scale", th.ones(1)),
        lambda n: n[3].register_buffer("running_mean", th.ones(2)),
        lambda n: setattr(n[0], "forward", lambda x: x),
        lambda n: parametrizations.weight_norm(n[0]),
        lambda n: prune.random_unstructured(n[0], "weight", amount=0.5),
    ],
)
def test_a_change_of_what_modules_hold_is_noticed(network, change):
    changes = ChangeDetector(network.modules())
    change(network)
    assert not changes.unchanged()


def test_without_tensors_only_children_and_attributes_count(network):
    changes = ChangeDetector(network.modules(), tensors=False)
    network[0].weight = nn.Parameter(th.zeros(4, 3))
    assert changes.unchanged()
    network[1] = nn.ReLU()
    assert not changes.unchanged()
