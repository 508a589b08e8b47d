"""Chains of sparse convolutions against dense, masked autograd."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from image_modules import EXACT, SMOOTH, drawn
from image_support import (
    KINDS,
    active,
    chains,
    close,
    compare,
    convolution,
    convolutions,
    gradients,
    impala,
    margin,
    twins,
    using,
    whole,
)
from torch import nn

from sb3_sparse.engine.image_pass import ImagePass
from sb3_sparse.engine.images import pays
from sb3_sparse.engine.native import library
from sb3_sparse.engine.residual import Residual
from sb3_sparse.engine.structure import Structure

CALLS = dict(
    kind=st.sampled_from(KINDS),
    batch=st.sampled_from([1, 2, 15, 16, 17, 33]),
    instructions=st.sampled_from(library.instruction_sets()),
    seed=st.integers(0, 2**20),
)


@settings(max_examples=150, deadline=None)
@given(network=drawn(EXACT, pools=3), **CALLS)
def test_whole_numbers_go_through_any_chain_as_through_dense_layers(
    network, kind, batch, instructions, seed
):
    # Sums are exact, so that equal entries of a window are equal to both sides: the first counts.
    dense, sparse = twins(*network.modules, seed=seed, kind=kind, whole=True)
    draws = th.Generator().manual_seed(seed)
    x = th.randint(-3, 4, (batch, *network.shape), generator=draws).float()
    with using(instructions):
        compare(dense, sparse, x, seed, whole=True)


@settings(max_examples=60, deadline=None)
@given(network=drawn(SMOOTH, pools=1), **CALLS)
def test_any_numbers_go_through_any_chain_as_through_dense_layers(
    network, kind, batch, instructions, seed
):
    dense, sparse = twins(*network.modules, seed=seed, kind=kind)
    x = th.randn(batch, *network.shape, generator=th.Generator().manual_seed(seed))
    assume(margin(dense, x) > 1e-5)
    with using(instructions):
        compare(dense, sparse, x, seed)


@pytest.mark.parametrize("batch", [1, 4, 5, 15, 16, 17, 33, 64])
def test_every_instruction_set_handles_every_batch(instructions, batch):
    dense, sparse = twins(*impala())
    x = th.randn(batch, 2, 7, 9, generator=th.Generator().manual_seed(4))
    compare(dense, sparse, x)
    assert chains(sparse) == [7]


@pytest.mark.parametrize("batch", [1, 5, 15])
def test_kernels_and_dense_weights_compute_few_images(ways, batch):
    dense, sparse = twins(*impala())
    x = th.randn(batch, 2, 7, 9, generator=th.Generator().manual_seed(4))
    compare(dense, sparse, x)
    assert chains(sparse) == [7]


def test_instruction_sets_agree():
    dense, sparse = twins(*impala()[:-1], whole=True)
    x = whole(20, 2, 7, 9)
    y = dense(x)
    y.backward(whole(*y.shape))
    grads = (
        grad
        for layer in convolutions(dense)
        for grad in (active(layer, layer.weight.grad), layer.bias.grad)
    )
    found = [[y.detach(), y[:1].detach(), *grads]]
    for name in library.instruction_sets():
        with using(name):
            sparse.zero_grad()
            y = sparse(x)
            y.backward(whole(*y.shape))
            with th.no_grad():
                acted = sparse(x[:1])
            found.append([y.detach(), acted, *gradients(sparse)])
    for ours in found[1:]:
        for one, expected in zip(ours, found[0], strict=True):
            np.testing.assert_array_equal(one, expected)


@pytest.mark.parametrize("batch", [1, 4, 40])
def test_results_do_not_depend_on_the_number_of_threads(batch):
    _, sparse = twins(*impala())
    x, before = th.randn(batch, 2, 7, 9), th.get_num_threads()
    found = []
    try:
        for count in (1, 2, 2, 3):
            th.set_num_threads(count)
            sparse.zero_grad()
            ours = x.clone().requires_grad_()
            y = sparse(ours)
            y.square().sum().backward()
            with th.no_grad():
                acted = sparse(x)
            grads = [p.grad.clone() for p in sparse.parameters()]
            found.append(([y.detach(), acted, ours.grad], grads))
    finally:
        th.set_num_threads(before)
    (results, grads), *others = found
    for other, sums in others:
        for ours, one in zip(other, results, strict=True):
            np.testing.assert_array_equal(ours, one)
        for ours, one in zip(sums, grads, strict=True):
            close(ours, one)
    for ours, one in zip(found[1][1], found[2][1], strict=True):
        np.testing.assert_array_equal(ours, one)


def test_a_graph_does_not_change_the_result():
    _, sparse = twins(*impala())
    x = th.randn(21, 2, 7, 9)
    with th.no_grad():
        acted = sparse(x)
    np.testing.assert_array_equal(acted, sparse(x).detach())


def test_an_empty_batch_has_gradients_of_zero():
    dense, sparse = twins(*impala())
    x = th.zeros(0, 2, 7, 9, requires_grad=True)
    y = sparse(x)
    assert y.shape == dense(x).shape
    y.sum().backward()
    assert x.grad.shape == x.shape
    assert not any(parameter.grad.any() for parameter in sparse.parameters())
    with th.no_grad():
        assert sparse(x).shape == y.shape


@pytest.mark.parametrize(
    ("modules", "expected"),
    [
        ([convolution(), nn.ReLU(), convolution(), nn.Tanh(), nn.MaxPool2d(2)], [3]),
        ([nn.ReLU(), convolution(), nn.ReLU()], [1]),
        ([nn.MaxPool2d(2), convolution()], [1]),
        ([nn.Sequential(nn.MaxPool2d(2), convolution()), convolution()], [3]),
        ([convolution(), nn.GELU(), convolution(), nn.ReLU(), convolution()], [1, 2]),
        ([convolution(), nn.MaxPool2d(2, ceil_mode=True), convolution()], [1, 1]),
        ([convolution(), nn.MaxPool2d(2, dilation=2), convolution()], [1, 1]),
        ([convolution(), nn.AvgPool2d(2), convolution()], [1, 1]),
        ([convolution(), nn.MaxPool2d([2, 3]), convolution()], [3]),
        ([Residual(convolution()), convolution()], [2]),
        ([convolution(), Residual(nn.ReLU(), convolution()), nn.ReLU(), convolution()], [3]),
        ([convolution(), nn.ReLU(), Residual(nn.MaxPool2d(3, 1, 1), convolution())], [3]),
        ([convolution(), Residual(convolution(), Residual(nn.ReLU(), convolution()))], [1]),
        ([convolution(), Residual(convolution(), nn.ReLU())], [1]),
        ([convolution(), nn.Flatten(), nn.ReLU()], [1]),
    ],
    ids=lambda value: (
        "" if isinstance(value[0], int) else "-".join(type(m).__name__ for m in value)
    ),
)
def test_what_the_kernels_compute_goes_through_them_in_as_few_calls_as_possible(modules, expected):
    dense, sparse = twins(*modules, whole=True)
    compare(dense, sparse, whole(17, 2, 5, 6), whole=True)
    assert chains(sparse) == expected


@pytest.mark.parametrize(
    ("batch", "nnz", "expected"),
    [(5, 15, True), (5, 16, False), (15, 45, True), (15, 46, False), (16, 96, True)],
)
def test_lanes_without_an_image_must_not_cost_more_than_zeros(batch, nnz, expected):
    # Of 96 connections; sixteen lanes at 15 of them are as much as 2 x 240 = 5 x 96.
    structures = [
        Structure(np.arange(nnz // 2), (4, 12)),
        Structure(np.arange(-(-nnz // 2)), (6, 8)),
    ]
    assert pays(batch, structures) is expected


def test_few_images_and_many_connections_take_dense_weights(monkeypatch):
    monkeypatch.setattr(
        "sb3_sparse.engine.images.pays", pays
    )  # the rule itself, which conftest.py turns off
    monkeypatch.setattr(ImagePass, "backward", None)  # which is not called
    dense, sparse = twins(convolution(), nn.ReLU(), convolution(), kind="full")
    compare(dense, sparse, th.randn(5, 2, 6, 5))
