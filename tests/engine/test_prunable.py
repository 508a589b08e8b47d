from __future__ import annotations

import pytest
from torch import nn

from sb3_sparse.engine.prunable import find_prunable
from sb3_sparse.errors import UnsupportedError


def test_linear_and_conv_are_prunable_and_norms_are_not():
    net = nn.Sequential(nn.Conv2d(1, 2, 3), nn.BatchNorm2d(2), nn.Flatten(), nn.Linear(8, 2))
    assert [name for name, _ in find_prunable(net, "net", lambda _: False)] == ["net.0", "net.3"]


def test_a_recurrent_layer_is_rejected_unless_it_stays_dense():
    net = nn.ModuleDict({"memory": nn.LSTM(3, 4), "head": nn.Linear(4, 1)})
    with pytest.raises(UnsupportedError, match=r"net.memory is a LSTM.*dense_layers"):
        list(find_prunable(net, "net", lambda _: False))
    found = find_prunable(net, "net", lambda name: name == "net.memory")
    assert [name for name, _ in found] == ["net.head"]
