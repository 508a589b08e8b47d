"""A sparse convolution against dense, masked autograd."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from engine_support import largest_while_moving
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.images import ImageChain
from sb3_sparse.engine.layer import dense_weight
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.sparse import SparseStorage
from sb3_sparse.engine.structure import Structure

pairs = st.tuples(st.integers(1, 4), st.integers(1, 4))


def twins(seed=0, density=0.4, channels=(3, 4), kernel=(3, 2), **kwargs) -> SimpleNamespace:
    """The same convolution, dense under a mask and sparse."""
    th.manual_seed(seed)
    dense = nn.Conv2d(*channels, kernel, **kwargs)
    mask = np.random.default_rng(seed).random(dense.weight.shape) < density
    with th.no_grad():
        dense.weight.mul_(th.from_numpy(mask))
    structure = Structure.of_mask(mask, (channels[1], mask[0].size))
    sparse = SparseConv2d.convert(copy.deepcopy(dense), structure, is_target=False)
    return SimpleNamespace(dense=dense, sparse=sparse, mask=th.from_numpy(mask))


def close(ours: th.Tensor, theirs: th.Tensor) -> None:
    """Equal to 1e-5 of the largest, or of 1 where terms of that size cancel out."""
    assert ours.shape == theirs.shape
    ours, theirs = ours.detach(), theirs.detach()
    scale = max(float(theirs.abs().max()), 1.0) if theirs.numel() else 1.0
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5 * scale)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 99),
    batch=st.sampled_from([1, 2, 33]),
    channels=pairs,
    kernel=pairs,
    stride=pairs,
    padding=st.tuples(st.integers(0, 2), st.integers(0, 2)),
    more=st.tuples(st.integers(0, 6), st.integers(0, 6)),
    bias=st.booleans(),
    density=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_results_and_gradients_are_those_of_the_dense_layer(
    seed, batch, channels, kernel, stride, padding, more, bias, density
):
    both = twins(seed, density, channels, kernel, stride=stride, padding=padding, bias=bias)
    size = [max(k - 2 * p, 1) + m for k, p, m in zip(kernel, padding, more, strict=True)]
    x = th.randn(batch, channels[0], *size)
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    y, expected = both.sparse(ours), both.dense(theirs)
    close(y, expected)
    with th.no_grad():
        close(both.sparse(x), expected)
        close(both.sparse(x[0]), expected[0])  # without a batch
    grad = th.randn(y.shape)
    y.backward(grad)
    expected.backward(grad)
    close(ours.grad, theirs.grad)
    close(both.sparse.weight.grad, both.dense.weight.grad[both.mask])
    if bias:
        close(both.sparse.bias.grad, both.dense.bias.grad)


def test_second_derivatives_are_those_of_the_dense_layer():
    both = twins()
    x = th.randn(2, 3, 5, 5)
    found = []
    for layer in (both.sparse, both.dense):
        loss = layer(x).pow(3).sum()
        (grad,) = th.autograd.grad(loss, layer.weight, create_graph=True)
        active = grad if layer is both.sparse else grad[both.mask]
        found.append(th.autograd.grad(active.pow(2).sum(), layer.weight)[0])
    close(found[0], found[1][both.mask])


def test_the_values_are_in_the_order_of_the_weight():
    structure = Structure(np.array([1, 4, 5]), (2, 4))
    values = th.tensor([1.0, 2.0, 3.0], requires_grad=True)
    weight = dense_weight(structure, values, (2, 1, 2, 2))
    assert weight.tolist() == [[[[0.0, 1.0], [0.0, 0.0]]], [[[2.0, 3.0], [0.0, 0.0]]]]
    (weight * th.arange(8.0).view(2, 1, 2, 2)).sum().backward()
    assert values.grad.tolist() == [1.0, 4.0, 5.0]


def watched_layer(functional: bool) -> SimpleNamespace:
    """A convolution in sparse storage that keeps its dense gradient, and its dense twin."""
    both = twins()
    module = copy.deepcopy(both.dense)
    masked = MaskedStorage("layer", module)
    masked.set_mask(both.mask.numpy())
    layer = SparseStorage(masked)
    layer.hook_gradient(functional, lambda: True)
    return SimpleNamespace(dense=both.dense, sparse=module, layer=layer)


def test_the_dense_gradient_reaches_inactive_connections_and_adds_up_over_passes(ways):
    both = watched_layer(functional=False)
    inputs = th.randn(2, 2, 3, 5, 5)
    for layer in (both.sparse, both.dense):
        (layer(inputs[0]).pow(2).sum() + layer(inputs[1]).pow(3).sum()).backward()
    found = both.layer.gradient_mask.take()()
    close(found, both.dense.weight.grad)
    assert (found.reshape(-1)[~both.layer.mask()] != 0).all()


def test_of_functional_gradients_the_first_without_a_graph_counts(ways):
    both = watched_layer(functional=True)
    x = th.randn(2, 3, 5, 5)
    for power, graph in ((2, True), (3, False), (4, False)):
        loss = both.sparse(x).pow(power).sum()
        th.autograd.grad(loss, both.sparse.weight, create_graph=graph)
    both.dense(x).pow(3).sum().backward()
    close(both.layer.gradient_mask.take()(), both.dense.weight.grad)


def test_a_result_does_not_keep_the_layer():
    both = watched_layer(functional=False)
    y = both.sparse(th.randn(1, 3, 5, 5))
    found = weakref.ref(both.sparse)
    del both
    gc.collect()
    assert found() is None
    y.sum().backward()


def test_a_layer_alone_keeps_its_chain(monkeypatch):
    made = []
    monkeypatch.setattr(
        "sb3_sparse.engine.convolution.ImageChain",
        lambda *args: made.append(args) or ImageChain(*args),
    )
    both = twins()
    x = th.randn(2, 3, 5, 5)
    for _ in range(3):
        close(both.sparse(x), both.dense(x))
    assert len(made) == 1
    both.sparse.stride = both.dense.stride = (2, 1)
    close(both.sparse(x), both.dense(x))
    assert len(made) == 2


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda net: pickle.loads(pickle.dumps(net))])
def test_a_copy_and_a_dense_layer_have_no_chain_of_another(duplicate):
    both = twins()
    x = th.randn(2, 3, 5, 5)
    both.sparse(x)
    other = duplicate(both.sparse)
    with th.no_grad():
        other.weight.zero_()
        other.bias.zero_()
    assert not other(x).any()
    close(both.sparse(x), both.dense(x))
    both.sparse.to_dense()
    assert type(both.sparse) is nn.Conv2d
    assert vars(both.sparse).keys() == vars(both.dense).keys()


def test_a_batch_goes_through_while_another_thread_moves_connections():
    x = th.ones(20, 300, 1, 1)
    found, allowed = largest_while_moving(
        (50, 300),
        (0.5, 0.01),
        lambda layer: lambda: layer(x),
        threads=1,
        layer=nn.Conv2d(300, 50, 1),
    )
    assert set(found) <= allowed


def test_a_state_dict_of_other_sizes_is_named():
    sparse = twins().sparse
    saved = sparse.state_dict()
    assert saved["weight"].shape == saved["weight_mask"].shape == (4, 3, 3, 2)
    with pytest.raises(
        RuntimeError, match=r"size mismatch for weight: .*\(4, 18\).*\(4, 3, 3, 2\)"
    ):
        sparse.load_state_dict({**saved, "weight": saved["weight"].view(4, 18)})
