"""Chains of sparse convolutions under whatever else calls, watches and copies modules."""

from __future__ import annotations

import copy
import gc
import itertools
import pickle
import threading
import weakref
from io import BytesIO

import numpy as np
import pytest
import torch as th
import torch.fx.experimental.proxy_tensor
from image_support import (
    active,
    chains,
    close,
    compare,
    convolution,
    convolutions,
    impala,
    twins,
    whole,
)
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode

from sb3_sparse.engine.convolution import SparseConv2d
from sb3_sparse.engine.images import pays
from sb3_sparse.engine.residual import Residual
from sb3_sparse.engine.reused import ReusedMemory
from sb3_sparse.engine.sequential import chain_up
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import UnsupportedError


@pytest.fixture
def both():
    """A part of the Impala ResNet, dense and sparse; modules 2 and 3 are residual blocks."""
    return twins(*impala())


@pytest.fixture
def x():
    return th.randn(17, 2, 7, 9, generator=th.Generator().manual_seed(0))


def gradients(network: nn.Module) -> list[th.Tensor]:
    return [parameter.grad.clone() for parameter in network.parameters()]


def inner(network: nn.Sequential) -> nn.Sequential:
    """The modules of a residual block."""
    return next(network[2].children())


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


def test_a_traced_network_is_the_network(both, x):
    dense, sparse = both
    with th.no_grad():
        traced = th.jit.trace(sparse, x[:2])
    for count in (1, 17):
        close(traced(x[:count]), dense(x[:count]))


def test_a_tracers_sizes_are_not_taken_for_numbers():
    _, sparse = twins(convolution())
    sparse(th.zeros(1, 2, 3, 3))
    ((chain, *_),) = sparse.requires_grad_(False)._split.steps
    before = chain._call.cache_info()
    with th.no_grad():
        th.jit.trace(lambda x: chain(x), th.zeros(1, 2, 4, 4), check_trace=False)
    assert chain._call.cache_info() == before


def test_who_watches_operations_sees_dense_ones(both, x):
    dense, sparse = both
    close(th.fx.experimental.proxy_tensor.make_fx(sparse)(x)(-x), dense(-x))
    close(th.func.vmap(sparse)(x), dense(x))
    (ours,), (theirs,) = (th.func.vjp(net, x)[1](th.ones(17, 2, 2, 4)) for net in (sparse, dense))
    close(ours, theirs)
    tangent = th.ones_like(x)
    close(th.func.jvp(sparse, (x,), (tangent,))[1], th.func.jvp(dense, (x,), (tangent,))[1])


def test_fake_tensors_have_the_shape(both, x):
    dense, sparse = both
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        y = sparse(mode.from_tensor(x))
    assert y.shape == dense(x).shape


def test_an_exported_network_has_dense_weights(both, x):
    onnx = pytest.importorskip("onnx", reason="needs onnx (pip install sb3-sparse[export])")
    reference = pytest.importorskip("onnx.reference")
    dense, sparse = both
    file = BytesIO()
    th.onnx.export(sparse, (x,), file, dynamo=False, input_names=["x"])
    file.seek(0)
    (y,) = reference.ReferenceEvaluator(onnx.load(file)).run(None, {"x": x.numpy()})
    close(th.from_numpy(y), dense(x))


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


def test_an_image_without_a_batch_and_strided_ones_are_taken_as_they_are(both, x):
    dense, sparse = both
    close(sparse(x[0]), dense(x[0]))
    wide = th.randn(17, 4, 14, 9)[:, 1:3, ::2]
    for strided in (wide, x.to(memory_format=th.channels_last), x[:1].expand(5, -1, -1, -1)):
        found = []
        for network in both:
            leaf = strided.detach().requires_grad_()
            y = network(leaf)
            y.square().sum().backward()
            found.append((y, leaf.grad))
        for ours, theirs in zip(found[1], found[0], strict=True):
            close(ours, theirs)
        with th.no_grad():
            close(sparse(strided[:2]), dense(strided[:2]))
    close(sparse(th._neg_view(x)), dense(-x))


def test_a_gradient_may_be_strided(both, x):
    found = []
    for network in both:
        network(x).sum().backward()  # its gradient is one number, expanded
        network(x).transpose(2, 3).contiguous().square().sum().backward()
        found.append(network[0].bias.grad)
    close(found[1], found[0])


@pytest.mark.parametrize("shape", [(17, 3, 7, 9), (17, 2, 7), (2, 7), (1, 17, 2, 7, 9), (3, 7, 9)])
def test_wrong_shapes_get_torchs_own_error(both, shape):
    messages = []
    for network in both:
        with pytest.raises(RuntimeError) as raised:
            network(th.zeros(shape))
        messages.append(str(raised.value))
    assert messages[0] == messages[1]


@pytest.mark.parametrize(
    ("modules", "size"),
    [
        (lambda: [convolution(), nn.Conv2d(2, 2, 3), nn.Conv2d(2, 2, 3)], (4, 9)),
        (lambda: [convolution(), nn.Conv2d(2, 2, 3), nn.Conv2d(2, 2, 3)], (0, 9)),
        (lambda: [nn.Conv2d(2, 2, 1, padding=1)], (0, 9)),
        (lambda: [nn.Conv2d(2, 2, 1, padding=1)], (4, 0)),
        (lambda: [nn.MaxPool2d(2, 1, 1), nn.Conv2d(2, 2, 1)], (4, 0)),
    ],
)
def test_images_that_are_too_small_get_torchs_own_error(modules, size):
    networks = twins(*modules())
    for batch in (1, 17):
        messages = []
        for network in networks:
            with pytest.raises(RuntimeError) as raised:
                network(th.zeros(batch, 2, *size))
            messages.append(str(raised.value))
        assert messages[0] == messages[1]


@pytest.mark.parametrize("dtype", [th.float64, th.float16, th.uint8])
def test_numbers_that_the_kernels_cannot_read_are_rejected(both, x, dtype):
    with pytest.raises(UnsupportedError, match="takes float32 on the CPU, got torch"):
        both[1](x.to(dtype))


def test_weights_that_the_kernels_cannot_read_are_rejected(both, x):
    _, sparse = both
    sparse[0].bias.data = th.zeros(6)[::2]
    with pytest.raises(UnsupportedError, match="must be contiguous float32"):
        sparse(x)


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


@pytest.mark.parametrize("batch", [2, 8, 17])
@pytest.mark.parametrize("graph", [False, True])
def test_under_autocast_sparse_layers_stay_float32(both, x, monkeypatch, batch, graph):
    monkeypatch.setattr("sb3_sparse.engine.images.pays", pays)
    dense, sparse = both
    mixed = nn.Sequential(nn.Conv2d(2, 2, 1), sparse)
    x = x[:batch]
    with th.autocast("cpu", dtype=th.bfloat16), th.set_grad_enabled(graph):
        y, part = mixed(x), sparse(x)
    assert y.dtype == part.dtype == th.float32
    np.testing.assert_allclose(y.detach(), dense(mixed[0](x)).detach(), atol=0.05)
    close(part, dense(x))


def test_torchs_defaults_change_nothing(both, x):
    dense, sparse = both
    expected = dense(x)
    th.set_default_dtype(th.float64)
    try:
        with th.device("meta"):
            y = sparse(x)
            y.sum().backward()
    finally:
        th.set_default_dtype(th.float32)
    close(y, expected)
    assert sparse[0].weight.grad.dtype == th.float32


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
