"""SimBa networks against torch's functions, written out by hand."""

from __future__ import annotations

import pytest
import torch as th
from simba_support import simba_by_hand
from torch import nn

from sb3_sparse.errors import ConfigError
from sb3_sparse.networks import SimbaBlock, simba


@pytest.mark.parametrize("blocks", [1, 3])
def test_outputs_and_gradients_are_those_of_the_formulas(blocks):
    th.manual_seed(0)
    network = simba(5, [8] * blocks).double()
    for parameter in network.parameters():
        parameter.data.add_(0.1 * th.randn_like(parameter))
    found = []
    for compute in (network, lambda x: simba_by_hand(dict(network.named_parameters()), blocks, x)):
        x = th.linspace(-2, 2, 35, dtype=th.float64).view(7, 5).requires_grad_()
        y = compute(x)
        network.zero_grad()
        (y.square().sum() + y[:, 0].exp().sum()).backward()
        found.append([y.detach(), x.grad, *(p.grad.clone() for p in network.parameters())])
    th.testing.assert_close(*found)


def test_a_block_by_hand():
    block = SimbaBlock(2)
    _, inner, _, outer = block.residual
    with th.no_grad():
        inner.weight.zero_()
        inner.weight[0] = th.tensor([2.0, 0.0])
        inner.bias.zero_()
        outer.weight.zero_()
        outer.weight[1, 0] = 3.0
        outer.bias.zero_()
    # (1, 3) is normalised to (-1, 1), (3, 1) to (1, -1); 2 * 1 passes the ReLU, and 3 * 2 is added.
    result = block(th.tensor([[1.0, 3.0], [3.0, 1.0]]))
    th.testing.assert_close(result, th.tensor([[1.0, 3.0], [3.0, 7.0]]), atol=1e-4, rtol=0)


def test_the_parameters_of_a_network_counted_by_hand():
    count = sum(parameter.numel() for parameter in simba(17, [256, 256]).parameters())
    block = 2 * 256 + (256 * 1024 + 1024) + (1024 * 256 + 256)
    assert count == (17 * 256 + 256) + 2 * block + 2 * 256


def test_initial_weights():
    th.manual_seed(0)
    network = simba(64, [256, 256])
    first, block = network[0], network[1]
    th.testing.assert_close(first.weight.T @ first.weight, th.eye(64), atol=1e-5, rtol=0)
    for layer, inputs in ((block.residual[1], 256), (block.residual[3], 1024)):
        assert layer.weight.std().item() == pytest.approx((2 / inputs) ** 0.5, rel=0.02)
        assert not layer.bias.any()
    assert isinstance(network[-1], nn.LayerNorm)


@pytest.mark.parametrize("net_arch", [[], [64, 128]])
def test_widths_that_no_residual_network_can_have(net_arch):
    with pytest.raises(ConfigError, match=r"one entry for each of its blocks, all of the same"):
        simba(3, net_arch)
