"""Chains of sparse convolutions follow hooks on their modules and changes to them."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
import torch.fx.experimental.proxy_tensor
from image_support import (
    chains,
    close,
    compare,
    convolution,
    convolutions,
    impala,
    inner,
    twins,
)
from torch import nn

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.residual import Residual
from sb3_sparse.engine.sequential import chain_up
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import UnsupportedError


def test_a_hooked_convolution_is_called_by_itself(both, x):
    dense, sparse = both
    seen = []
    for network in both:
        network[0].register_forward_hook(lambda module, inputs, y: seen.append(y))
    close(sparse(x), dense(x))
    close(seen[0], seen[1])


@pytest.mark.parametrize("place", [0, 1, 2, 3])
@pytest.mark.parametrize("batch", [1, 17])
def test_a_hook_within_a_block_sees_what_goes_through_it(both, x, place, batch):
    seen, back = [], []
    for network in both:
        module = inner(network)[place]
        module.register_forward_hook(lambda module, inputs, y: seen.append((inputs[0], y)))
        module.register_full_backward_hook(lambda module, grads, outer: back.append(outer[0]))
        network(x[:batch]).square().sum().backward()
    with th.no_grad():
        for network in both:
            network(x[:batch])
    assert len(seen) == 4
    assert len(back) == 2
    for number in (1, 3):
        for ours, theirs in zip(seen[number], seen[number - 1], strict=True):
            close(ours, theirs)
    close(back[1], back[0])


def test_a_hook_may_change_what_goes_through_a_block(both, x):
    dense, sparse = both
    before = sparse(x)
    for network in both:
        network[2].register_forward_hook(lambda module, inputs, y: 2 * y)
    close(sparse(x), dense(x))
    assert not th.allclose(sparse(x), before)


def test_a_removed_hook_gives_the_chain_back(both, x):
    _, sparse = both
    count = []
    handle = inner(sparse)[1].register_forward_pre_hook(lambda *_: count.append(0))
    sparse(x)
    handle.remove()
    sparse(x)
    assert len(count) == 1
    assert chains(sparse) == [7]


def test_what_is_hooked_everywhere_is_called_by_itself(both, x):
    names = []
    for network in both:
        found = []
        handle = nn.modules.module.register_module_forward_hook(
            lambda module, inputs, y, found=found: found.append(tuple(y.shape))
        )
        network(x)
        handle.remove()
        names.append(found)
    assert len(names[0]) == len(list(both[0].modules()))
    assert names[0] == names[1]


@pytest.mark.parametrize("find", [lambda n: n[0], lambda n: n[2], inner, lambda n: inner(n)[3]])
def test_a_patched_forward_is_called(both, x, find):
    for network in both:
        module = find(network)
        forward = module.forward
        module.forward = lambda x, forward=forward: forward(x) + 1
    close(both[1](x), both[0](x))
    with th.no_grad():
        close(both[1](x[:1]), both[0](x[:1]))


def test_a_changed_network_is_noticed(both, x):
    dense, sparse = both
    sparse(x)
    for network in both:
        inner(network)[0] = nn.Tanh()
    close(sparse(x), dense(x))
    for network in both:
        network[2] = nn.Identity()
    close(sparse(x), dense(x))


@pytest.mark.parametrize(
    ("find", "name", "value"),
    [
        (lambda network: network[0], "stride", (2, 1)),
        (lambda network: network[0], "padding", (2, 0)),
        (lambda network: network[4], "stride", 1),
        (lambda network: network[1], "kernel_size", 2),
        (lambda network: network[1], "stride", (1, 2)),
        (lambda network: network[1], "padding", 0),
        (lambda network: network[1], "ceil_mode", True),
        (lambda network: network[1], "dilation", 2),
        (lambda network: inner(network)[0], "inplace", True),
    ],
)
def test_a_changed_attribute_is_noticed(both, x, find, name, value):
    x = x[..., :6, :8]
    compare(*both, x)
    before = both[1](x)
    for network in both:
        setattr(find(network), name, value)
    compare(*both, x)
    now = both[1](x)
    assert now.shape != before.shape or not th.allclose(now, before)


def test_an_attribute_that_changes_in_place_is_noticed(x):
    dense, sparse = twins(convolution(), nn.MaxPool2d([2, 3]))
    for _ in range(2):
        compare(dense, sparse, x)
        dense[1].kernel_size[0] = sparse[1].kernel_size[0] = 1


def test_a_pooling_may_give_its_places_later(x):
    dense, sparse = twins(convolution(), nn.MaxPool2d(2))
    close(sparse(x), dense(x))
    dense[1].return_indices = sparse[1].return_indices = True
    close(sparse(x)[0], dense(x)[0])
    np.testing.assert_array_equal(sparse(x)[1], dense(x)[1])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("padding_mode", "reflect"),
        ("padding", "same"),
        ("groups", 2),
        ("dilation", (2, 2)),
        ("kernel_size", (2, 3)),
    ],
)
@pytest.mark.parametrize("called", [False, True])
def test_a_convolution_that_becomes_another_kind_is_rejected(x, name, value, called):
    _, sparse = twins(convolution(), nn.ReLU(), Residual(convolution()))
    if called:
        sparse(x)
    for layer in convolutions(sparse):
        before = getattr(layer, name)
        setattr(layer, name, value)
        for call in (lambda: sparse(x), lambda layer=layer: layer(x)):
            with pytest.raises(
                UnsupportedError, match="has no groups and no dilation.* got .*'masked'"
            ):
                call()
        setattr(layer, name, before)
    sparse(x)


def test_layers_that_become_sparse_later_join_the_chain(x):
    dense, _ = twins(*impala())
    growing = copy.deepcopy(dense)
    for layer in list(convolutions(growing))[::-1]:
        matrix = (layer.out_channels, layer.weight[0].numel())
        SparseConv2d.convert(layer, Structure.of_mask(layer.mask.numpy(), matrix), is_target=False)
        chain_up(growing)
        close(growing(x), dense(x))
    assert chains(growing) == [7]


def test_a_part_of_a_network_computes_that_part(both, x):
    dense, sparse = both
    close(sparse[:2](x), dense[:2](x))
    assert sparse[:2]._split is None  # it has its own
    close(sparse[2:](sparse[:2](x)), sparse(x))
    with th.no_grad():
        close(sparse[:2](x[:1]), dense[:2](x[:1]))
