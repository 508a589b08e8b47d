"""Graphs and memory of chains of sparse convolutions."""

from __future__ import annotations

import copy
import gc
import itertools
import pickle
import threading
import weakref

import numpy as np
import pytest
import torch as th
import torch.fx.experimental.proxy_tensor
from image_support import (
    active,
    close,
    convolution,
    convolutions,
    gradients,
    impala,
    inner,
    twins,
    whole,
)
from torch import nn

from sb3_sparse.engine.reused import ReusedMemory
from sb3_sparse.engine.structure import Structure


def test_second_derivatives_are_those_of_dense_layers(both, x):
    def curvature(network: nn.Module) -> list[th.Tensor]:
        parameters = list(network.parameters())
        loss = network(x).pow(3).sum()
        first = th.autograd.grad(loss, parameters, create_graph=True)
        return list(th.autograd.grad(sum(g.square().sum() for g in first), parameters))

    dense, sparse = both
    for layer in convolutions(dense):  # inactive weights have no second derivative either
        layer.weight.register_hook(lambda grad, layer=layer: grad * layer.mask)
    ours, theirs = iter(curvature(sparse)), iter(curvature(dense))
    for layer in convolutions(dense):
        close(next(ours), active(layer, next(theirs)))
        close(next(ours), next(theirs))


def test_several_gradients_at_once_are_those_one_by_one():
    _, sparse = twins(*impala()[:-1], whole=True)  # so that sums are exact in any order
    ours = whole(17, 2, 7, 9).requires_grad_()
    y = sparse(ours)
    grads = whole(3, *y.shape)
    wanted = [ours, sparse[0].weight, sparse[0].bias]
    found = th.autograd.grad(y, wanted, grads, is_grads_batched=True, retain_graph=True)
    for number, grad in enumerate(grads):
        one = th.autograd.grad(y, wanted, grad, retain_graph=True)
        for several, single in zip(found, one, strict=True):
            np.testing.assert_array_equal(several[number], single)


def test_a_graph_may_be_used_twice(both, x):
    _, sparse = both
    y = sparse(x).square().sum()
    y.backward(retain_graph=True)
    once = gradients(sparse)
    y.backward()
    for twice, grad in zip(gradients(sparse), once, strict=True):
        np.testing.assert_array_equal(twice, 2 * grad)


@pytest.mark.parametrize("order", itertools.permutations(range(3)))
def test_graphs_that_live_together_do_not_share_memory(both, x, order):
    _, sparse = both
    inputs = [x, -x, x[:5]]
    alone = []
    for one in inputs:
        sparse.zero_grad()
        sparse(one).square().sum().backward()
        alone.append(gradients(sparse))
    results = [sparse(one).square().sum() for one in inputs]
    for number in order:
        sparse.zero_grad()
        results[number].backward()
        for ours, theirs in zip(gradients(sparse), alone[number], strict=True):
            np.testing.assert_array_equal(ours, theirs)
        with th.no_grad():
            sparse(x)  # what has no graph, and what has one for a moment, leave the others alone
        sparse(2 * x).square().sum()


def test_memory_is_used_again_once_a_graph_is_gone():
    memory = ReusedMemory()

    def place(size: int) -> int:
        return memory(size).data_ptr()

    first = memory(100)
    assert place(100) != first.data_ptr()
    again = place(100)
    part = memory(100)[50:]
    assert part.data_ptr() == again + 4 * 50
    assert place(100) != again
    again = place(100)
    assert place(50) == again
    kept = memory(100)
    assert memory(0).numel() == 0  # it does not replace the block
    del kept
    assert place(100) == again
    assert place(101) != again


def test_memory_is_given_back_that_is_twice_too_large():
    memory = ReusedMemory()
    for size, kept in ((100, 100), (50, 100), (49, 49), (10**6, 10**6), (7, 7)):
        assert memory(size).numel() == size
        ((block, _),) = memory._blocks
        assert block.numel() == kept


def test_only_so_many_sizes_of_images_stay_prepared(both):
    _, sparse = both
    for height in range(5, 26):
        sparse(th.zeros(1, 2, height, 5))
    ((chain, *_),) = sparse._split.steps
    assert chain._call.cache_info().currsize == 16


def test_steps_of_training_share_their_memory(both, x):
    _, sparse = both
    sparse(x).sum().backward()
    ((step, *_),) = sparse._split.steps
    ((block, _),) = step._memory._blocks
    for _ in range(3):
        sparse(x).sum().backward()
        with th.no_grad():
            sparse(x)
        ((again, _),) = step._memory._blocks
        assert again is block


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda net: pickle.loads(pickle.dumps(net))])
def test_copies_between_the_passes_leave_them_alone(both, x, duplicate):
    dense, sparse = both
    sparse(x).square().sum().backward()
    alone = gradients(sparse)
    sparse.zero_grad()
    y = sparse(x)
    other = duplicate(sparse)
    close(other(x), y)
    other(-x).square().sum().backward()
    y.square().sum().backward()
    for ours, theirs in zip(gradients(sparse), alone, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for parameter in other.parameters():
        parameter.data.zero_()
    assert not other(x).any()
    close(sparse(x), dense(x))


def test_threads_act_and_train_at_once(both, x):
    _, sparse = both
    other = copy.deepcopy(sparse)  # so that each thread finds the chains for itself
    other(x).square().sum().backward()
    alone, expected, wrong = gradients(other), other(x).detach(), []

    def act() -> None:
        with th.no_grad():
            for count in itertools.islice(itertools.cycle([1, 17]), 60):
                if not th.allclose(sparse(x[:count]), expected[:count], atol=1e-5):
                    wrong.append(count)

    def train() -> None:
        for _ in range(30):
            found = th.autograd.grad(sparse(x).square().sum(), list(sparse.parameters()))
            if not all(map(th.equal, found, alone)):
                wrong.append("gradients")

    threads = [threading.Thread(target=work) for work in (act, act, train, train)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_inference_mode_leaves_nothing_behind(both, x):
    dense, sparse = both
    with th.inference_mode():
        for count in (1, 17):
            close(sparse(x[:count]), dense(x[:count]))
    sparse(x).sum().backward()


def test_a_result_does_not_keep_the_network(x):
    _, sparse = twins(*impala())
    y = sparse(x)
    found = weakref.ref(sparse[0])
    del sparse
    gc.collect()
    assert found() is None
    y.sum().backward()


def test_a_gradient_may_be_strided(both, x):
    found = []
    for network in both:
        network(x).sum().backward()  # its gradient is one number, expanded
        network(x).transpose(2, 3).contiguous().square().sum().backward()
        found.append(network[0].bias.grad)
    close(found[1], found[0])


def test_connections_that_change_between_the_passes_are_noticed(both, x):
    _, sparse = both
    y = sparse(x)
    sparse[0].restructure(Structure(np.arange(4), (3, 18)), th.ones(4))
    with pytest.raises(RuntimeError, match="connections have changed between"):
        y.sum().backward()


def test_weights_that_change_between_the_passes_are_noticed(both, x):
    _, sparse = both
    y = sparse(x)
    with th.no_grad():
        inner(sparse)[1].weight.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        y.sum().backward()


def test_what_follows_may_work_in_place(both, x):
    found = []
    for network in both:
        leaf = x.clone().requires_grad_()
        y = network[:4](leaf)
        y.relu_().square().sum().backward()
        found.append(leaf.grad)
    close(found[1], found[0])


def test_no_memory_is_read_before_it_is_written(x):
    dense, sparse = twins(
        *impala(), nn.Conv2d(2, 3, 1, (1, 2)), nn.MaxPool2d(2, 1), convolution(3, 1)
    )
    th.use_deterministic_algorithms(True)  # fills what is not written with NaN
    try:
        with th.autograd.detect_anomaly(check_nan=True):
            sparse(x).sum().backward()
            with th.no_grad():
                close(sparse(x), dense(x))
                close(sparse(x[:1]), dense(x[:1]))
    finally:
        th.use_deterministic_algorithms(False)
    assert not any(grad.isnan().any() for grad in gradients(sparse))
