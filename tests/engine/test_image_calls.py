"""Chains of sparse convolutions under tracing, and on inputs of every kind."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
import torch as th
import torch.fx.experimental.proxy_tensor
from image_support import (
    close,
    convolution,
    twins,
)
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode

from sb3_sparse.engine.images import pays
from sb3_sparse.errors import UnsupportedError


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


@pytest.mark.parametrize("batch", [2, 8, 17])
@pytest.mark.parametrize("graph", [False, True])
def test_under_autocast_sparse_layers_stay_float32(both, x, monkeypatch, batch, graph):
    monkeypatch.setattr(
        "sb3_sparse.engine.images.pays", pays
    )  # the rule itself, which conftest.py turns off
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
