"""Chains of sparse convolutions where poolings, blocks and numbers are special."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from image_support import chains, close, compare, convolution, impala, twins, whole
from torch import nn

from sb3_sparse.engine.residual import Residual


def passed_on(network: nn.Module, x: th.Tensor) -> th.Tensor:
    """The gradient of the input where each result counts by its place."""
    x = x.clone().requires_grad_()
    y = network(x)
    y.backward(th.arange(1.0, y.numel() + 1).view(y.shape))
    return x.grad


def pooled(*window: object) -> tuple[nn.Sequential, nn.Sequential]:
    dense, sparse = twins(nn.MaxPool2d(*window), nn.Conv2d(1, 1, 1), kind="full")
    with th.no_grad():
        for layer in (dense[1], sparse[1]):
            layer.weight.fill_(1.0)
            layer.bias.fill_(0.0)
    return dense, sparse


@pytest.mark.parametrize("window", [(2, 2, 0), (3, 2, 1), (3, 1, 1), ((2, 3), (1, 2), (1, 0))])
@pytest.mark.parametrize("value", [0.0, -2.5, float("-inf")])
def test_of_equal_entries_the_first_is_taken(instructions, window, value):
    dense, sparse = pooled(*window)
    x = th.full((18, 1, 5, 6), value)
    np.testing.assert_array_equal(passed_on(sparse, x), passed_on(dense, x))
    # By hand: of four corners of a window the one above and left counts.
    x = whole(2, 1, 2, 2) * 0
    assert passed_on(pooled(2)[1], x).tolist() == [[[[1, 0], [0, 0]]], [[[2, 0], [0, 0]]]]


@pytest.mark.parametrize("batch", [1, 17])
def test_what_is_not_a_number_stays_that(instructions, batch):
    dense, sparse = twins(convolution(), nn.ReLU(), nn.MaxPool2d(3, 2, 1), convolution(), nn.ReLU())
    x = th.randn(batch, 2, 6, 5)
    x[batch - 1, 1, 2, 3] = float("nan")
    with th.no_grad():
        expected = dense(x)
        for y in (sparse(x), sparse(x.requires_grad_())):
            np.testing.assert_array_equal(y.isnan(), expected.isnan())
            assert y[-1].isnan().any()
            assert not y[:-1].isnan().any()


def test_of_several_nans_and_none_torchs_choice_is_taken(instructions):
    dense, sparse = pooled(3, 2, 1)
    x = whole(16, 1, 7, 7)
    x[whole(16, 1, 7, 7, seed=1) > 1] = float("nan")
    np.testing.assert_array_equal(passed_on(sparse, x), passed_on(dense, x))


def test_infinite_entries_go_through(instructions):
    dense, sparse = pooled(2, 2, 1)
    x = whole(17, 1, 5, 4)
    x[x == 3] = float("inf")
    x[x < 0] = float("-inf")
    np.testing.assert_array_equal(passed_on(sparse, x), passed_on(dense, x))
    with th.no_grad():
        np.testing.assert_array_equal(sparse(x[:1]), dense(x[:1]))


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (2, 3)])
def test_windows_may_reach_beyond_small_images(instructions, size):
    dense, sparse = twins(nn.MaxPool2d(3, 2, 1), convolution(), nn.MaxPool2d(3, 2, 1), whole=True)
    for batch in (1, 17):
        compare(dense, sparse, whole(batch, 2, *size), whole=True)


@pytest.mark.parametrize("batch", [1, 17])
@pytest.mark.parametrize("first", [nn.Tanh(), nn.Hardtanh(-1.0, 1.0), nn.SELU(), nn.ReLU()])
def test_a_block_may_begin_with_relu_behind_another_activation(instructions, batch, first):
    dense, sparse = twins(convolution(), first, Residual(nn.ReLU(), convolution()))
    x = th.randn(batch, 2, 5, 4, generator=th.Generator().manual_seed(0))
    compare(dense, sparse, x)
    assert chains(sparse) == [2]


@pytest.mark.parametrize(
    "block",
    [
        lambda: Residual(Residual(convolution()), convolution()),
        lambda: Residual(Residual(convolution(), convolution()), nn.ReLU(), convolution()),
        lambda: Residual(nn.ReLU(), Residual(convolution()), convolution()),
        lambda: Residual(convolution(), Residual(nn.ReLU(), convolution()), convolution()),
        lambda: Residual(convolution(), Residual(convolution())),
        lambda: Residual(Residual(nn.ReLU(inplace=True), convolution()), convolution()),
        lambda: Residual(nn.ReLU(inplace=True), convolution()),
        lambda: Residual(convolution(), nn.ReLU(inplace=True), convolution()),
        lambda: Residual(),
    ],
)
def test_blocks_add_what_they_add_elsewhere(block):
    dense, sparse = twins(convolution(), block(), convolution(), whole=True)
    compare(dense, sparse, whole(17, 2, 5, 4), whole=True)
    compare(*twins(nn.Hardtanh(-9.0, 9.0), block(), convolution(), whole=True), whole(3, 2, 5, 4))


class Measured(Residual):
    """A user's block with a module that its forward pass does not call."""

    def __init__(self, *layers: nn.Module) -> None:
        super().__init__(*layers)
        self.probe = nn.MaxPool2d(2)


class Halved(Residual):
    """A user's block that adds half."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        return x + 0.5 * self.get_submodule(self.name)(x)


@pytest.mark.parametrize("kind", [Measured, Halved])
def test_a_users_block_is_called_by_itself(kind):
    dense, sparse = twins(convolution(), kind(nn.ReLU(), convolution()), whole=True)
    compare(dense, sparse, whole(17, 2, 4, 6), whole=True)
    assert chains(sparse) == [1]


def test_a_layer_may_be_called_twice():
    layer, block = convolution(), Residual(nn.ReLU(), convolution())
    dense, sparse = twins(layer, nn.ReLU(), layer, block, block, whole=True)
    compare(dense, sparse, whole(17, 2, 4, 5), whole=True)
    assert chains(sparse) == [4]


def test_an_activation_within_a_sequence_may_be_called_twice():
    tanh = nn.Tanh()
    dense, sparse = twins(nn.Sequential(convolution(), tanh, convolution(), tanh), convolution())
    compare(dense, sparse, th.randn(17, 2, 5, 4))
    assert chains(sparse) == [3]


def test_a_slope_may_change_between_two_calls():
    after = nn.LeakyReLU(0.5)
    dense, sparse = twins(convolution(), after, convolution())
    x = whole(17, 2, 5, 4)
    for slope in (0.5, 0.25, -0.25):
        dense[1].negative_slope = sparse[1].negative_slope = slope
        close(sparse(x), dense(x))
        with th.no_grad():
            close(sparse(x[:1]), dense(x[:1]))


def test_convolutions_without_any_gradient_pass_it_on():
    dense, sparse = twins(*impala())
    x = th.randn(20, 2, 7, 9)
    for parameter in (*dense.parameters(), *sparse.parameters()):
        parameter.requires_grad_(False)
    sparse[0].bias.requires_grad_()
    dense[0].bias.requires_grad_()
    close(passed_on(sparse, x), passed_on(dense, x))
    close(sparse[0].bias.grad, dense[0].bias.grad)
    assert sparse[0].weight.grad is None
