"""The kernels against dense, masked autograd."""

from __future__ import annotations

import copy
import threading
from functools import partial

import numpy as np
import pytest
import torch as th
import torch.fx.experimental.proxy_tensor
from engine_support import largest_while_moving
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional

from sb3_sparse.engine.activations import tells_its_slope
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.native import library
from sb3_sparse.engine.sequential import ChainedSequential, chain_up
from sb3_sparse.engine.structure import Structure
from sb3_sparse.errors import ConfigError, UnsupportedError

TOLERANCE = 1e-5
ELEMENTWISE = [
    nn.Identity,
    nn.ReLU,
    nn.Tanh,
    nn.Sigmoid,
    nn.ELU,
    partial(nn.ELU, 0.3),
    partial(nn.ELU, -0.5),
    partial(nn.CELU, 1.4),
    nn.SELU,
    partial(nn.LeakyReLU, 0.2),
    partial(nn.LeakyReLU, -0.2),
    nn.ReLU6,
    partial(nn.Hardtanh, -0.4, 0.6),
    nn.SiLU,
    nn.GELU,
    nn.Softplus,
]


@pytest.fixture
def threads():
    before = th.get_num_threads()
    yield th.set_num_threads
    th.set_num_threads(before)


def random_mask(shape, kind: str, random: np.random.Generator) -> np.ndarray:
    if kind == "full":
        return np.ones(shape, dtype=bool)
    mask = random.random(shape) < 0.3
    if kind == "empty row":
        mask[random.integers(shape[0])] = False
    if kind == "full row":
        mask[random.integers(shape[0])] = True
    if kind == "empty":
        mask[:] = False
    return mask


def networks(widths, kinds, activation, bias, seed) -> tuple[nn.Sequential, nn.Sequential]:
    """The same layers dense under masks, and sparse."""
    random = np.random.default_rng(seed)
    th.manual_seed(seed)
    dense, sparse = [], []
    for i, (columns, rows) in enumerate(zip(widths, widths[1:], strict=False)):
        mask = random_mask((rows, columns), kinds[i % len(kinds)], random)
        layer, twin = nn.Linear(columns, rows, bias=bias), nn.Linear(columns, rows, bias=bias)
        with th.no_grad():
            layer.weight.mul_(th.from_numpy(mask))
        twin.load_state_dict(layer.state_dict())
        layer.mask = mask
        dense += [layer, activation()]
        sparse += [
            SparseLinear.convert(twin, Structure.of_mask(mask, mask.shape), is_target=False),
            activation(),
        ]
    dense.pop()
    sparse.pop()
    result = nn.Sequential(*sparse)
    chain_up(result)
    assert type(result) is ChainedSequential
    return nn.Sequential(*dense), result


def close(ours: th.Tensor, theirs: th.Tensor, usual: float = 1e-2) -> None:
    """Equal to 1e-5 of the largest, or of what is usual where terms may cancel out."""
    scale = max(float(theirs.detach().abs().max()), usual) if theirs.numel() else 1.0
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(ours.detach(), theirs.detach(), rtol=0, atol=TOLERANCE * scale)


def compare(dense, sparse, batch, seed=0) -> None:
    random = th.Generator().manual_seed(seed)
    x = th.randn(batch, dense[0].in_features, generator=random)
    grad = th.randn(batch, dense[-1].out_features, generator=random)
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    y = sparse(ours)
    close(y, dense(theirs))
    with th.no_grad():
        close(sparse(x), y)
        for row in range(min(3, batch)):
            close(sparse(x[row : row + 1]), y[row : row + 1])
    y.backward(grad)
    terms = {}

    def note(layer, inputs, output):
        output.register_hook(lambda grad: terms.update({layer: (inputs[0].detach(), grad)}))

    for layer in dense:
        if isinstance(layer, nn.Linear):
            layer.register_forward_hook(note)
    dense(theirs).backward(grad)
    close(ours.grad, theirs.grad)
    for layer, twin in zip(dense, sparse, strict=True):
        if isinstance(layer, nn.Linear):
            # A sum of terms of random signs has the size of their root sum of squares.
            squares, slopes = (part.square() for part in terms[layer])
            mask = th.from_numpy(layer.mask)
            usual = float((slopes.T @ squares).sqrt().max())
            close(twin.weight.grad, layer.weight.grad[mask], usual)
            if layer.bias is not None:
                close(twin.bias.grad, layer.bias.grad, float(slopes.sum(0).sqrt().max()))


KINDS = ["some", "full", "empty row", "full row", "empty"]


@settings(max_examples=60, deadline=None)
@given(
    widths=st.lists(st.integers(1, 70), min_size=2, max_size=5),
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=4),
    activation=st.sampled_from(ELEMENTWISE),
    batch=st.integers(1, 200),
    bias=st.booleans(),
    seed=st.integers(0, 2**20),
)
def test_results_and_gradients_are_those_of_dense_masked_layers(
    widths, kinds, activation, batch, bias, seed
):
    compare(*networks(widths, kinds, activation, bias, seed), batch, seed)


@pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh])
@pytest.mark.parametrize("batch", [1, 15, 16, 17, 48, 63, 64, 65, 128, 250])
def test_every_instruction_set_handles_every_batch(instructions, batch, activation):
    compare(*networks([23, 70, 33, 1], ["some", "full row"], activation, True, 3), batch)


def test_results_do_not_depend_on_the_number_of_threads(threads):
    dense, sparse = networks([40, 90, 50], ["some"], nn.ReLU, True, 1)
    x = th.randn(333, 40)
    found = []
    for count in (1, 2, 5):
        threads(count)
        sparse.zero_grad()
        y = sparse(x)
        y.square().sum().backward()
        found.append([y.detach(), *(p.grad.clone() for p in sparse.parameters())])
    for several in found[1:]:
        np.testing.assert_array_equal(several[0], found[0][0])
        for ours, one in zip(several[1:], found[0][1:], strict=True):
            close(ours, one)


def test_instruction_sets_agree():
    if len(library.instruction_sets()) == 1:
        pytest.skip("this processor has one instruction set only")
    _, sparse = networks([40, 90, 50], ["some"], nn.ReLU, True, 1)
    x = th.randn(100, 40)
    best = library.in_use()
    found = []
    for name in library.instruction_sets():
        library.use(name)
        found.append(sparse(x).detach())
    library.use(best)
    for other in found[1:]:
        close(other, found[0])


def test_an_unknown_instruction_set_is_rejected():
    with pytest.raises(ConfigError, match="these do: .*"):
        library.use("altivec")


def test_leading_dimensions_stay_and_a_single_vector_too():
    dense, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    for shape in [(5,), (7, 5), (2, 3, 5), (0, 5)]:
        x = th.randn(shape)
        close(sparse(x), dense(x))


def test_an_empty_batch_has_gradients_of_zero():
    _, sparse = networks([5, 8, 3], ["some"], nn.Tanh, True, 0)
    x = th.zeros(0, 5, requires_grad=True)
    sparse(x).sum().backward()
    assert x.grad.shape == (0, 5)
    assert not any(parameter.grad.any() for parameter in sparse.parameters())


def test_a_strided_input_is_taken_as_it_is():
    dense, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    x = th.randn(9, 10)[:, ::2]
    close(sparse(x), dense(x))


@pytest.mark.parametrize(
    "x",
    [th.zeros(4, 6), th.zeros(4, 5, dtype=th.float64), th.zeros(())],
    ids=["wide", "double", "0d"],
)
def test_what_the_kernels_cannot_read_is_rejected(x):
    _, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    with pytest.raises(UnsupportedError, match="takes float32 on the CPU with 5 features"):
        sparse(x)


def test_what_is_not_a_number_stays_that():
    dense, sparse = networks([5, 8, 3], ["full"], nn.ReLU, True, 0)
    x = th.zeros(4, 5)
    x[2, 1] = float("nan")
    assert th.isnan(sparse(x)[2]).all()
    assert not th.isnan(sparse(x)[[0, 1, 3]]).any()
    assert th.isnan(dense(x)[2]).all()


def test_weights_without_gradient_get_none_and_pass_it_on():
    dense, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    x = th.randn(7, 5)
    ours, theirs = x.clone().requires_grad_(), x.clone().requires_grad_()
    for parameter in sparse.parameters():
        parameter.requires_grad_(False)
    sparse(ours).sum().backward()
    dense(theirs).sum().backward()
    close(ours.grad, theirs.grad)
    assert all(parameter.grad is None for parameter in sparse.parameters())


def test_second_derivatives_as_trpo_takes_them():
    dense, sparse = networks([5, 8, 3], ["some"], nn.Tanh, True, 0)
    x = th.randn(70, 5)

    def curvature(network: nn.Module) -> list[th.Tensor]:
        parameters = list(network.parameters())
        loss = network(x).square().sum()
        first = th.autograd.grad(loss, parameters, create_graph=True)
        return list(th.autograd.grad(sum(g.square().sum() for g in first), parameters))

    masks = [th.from_numpy(layer.mask) for layer in dense if isinstance(layer, nn.Linear)]
    # Masked weights have no second derivative by what is inactive either.
    flat = [layer for layer in dense if isinstance(layer, nn.Linear)]
    for layer, mask in zip(flat, masks, strict=True):
        layer.weight.register_hook(lambda grad, mask=mask: grad * mask)
    ours, theirs = curvature(sparse), curvature(dense)
    for i, (mine, other) in enumerate(zip(ours, theirs, strict=True)):
        close(mine, other if i % 2 else other[masks[i // 2]])


def test_a_hooked_module_is_called_by_itself():
    dense, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    seen = []
    handle = sparse[1].register_forward_hook(lambda module, inputs, y: seen.append(y))
    x = th.randn(7, 5)
    close(sparse(x), dense(x))
    close(seen[0], functional.relu(dense[0](x)))
    handle.remove()
    sparse(x)
    assert len(seen) == 1


def test_a_changed_sequence_is_noticed():
    dense, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    x = th.randn(7, 5)
    sparse(x)
    sparse.append(nn.Tanh())
    close(sparse(x), th.tanh(dense(x)))
    sparse[1] = nn.Sigmoid()
    close(sparse(x), th.tanh(dense[2](th.sigmoid(dense[0](x)))))


def test_modules_that_look_at_whole_rows_get_rows():
    dense, sparse = networks([5, 8, 8, 3], ["some"], nn.ReLU, True, 0)
    norm = nn.LayerNorm(8)
    x = th.randn(70, 5)
    close(
        chained(sparse[0], norm, sparse[1], sparse[2])(x),
        nn.Sequential(dense[0], norm, dense[1], dense[2])(x),
    )


@pytest.mark.parametrize("activation", [nn.ELU, nn.LeakyReLU, nn.ReLU, nn.SELU])
def test_activations_may_work_in_place(activation):
    compare(*networks([5, 8, 7, 3], ["some"], partial(activation, inplace=True), True, 0), 70)


def test_a_traced_network_is_the_network():
    dense, sparse = networks([5, 8, 3], ["some"], nn.Tanh, True, 0)
    with th.no_grad():
        traced = th.jit.trace(sparse, th.randn(2, 5))
    x = th.randn(7, 5)
    close(traced(x), dense(x))


def test_who_watches_operations_sees_dense_ones():
    dense, sparse = networks([5, 8, 3], ["some"], nn.Tanh, True, 0)
    x = th.randn(7, 5)
    close(th.fx.experimental.proxy_tensor.make_fx(sparse)(x)(-x), dense(-x))
    close(th.func.vmap(sparse)(x), dense(x))


def test_negated_views_are_what_they_say():
    dense, sparse = networks([5, 8, 3], ["some"], nn.Tanh, True, 0)
    x = th.randn(7, 5)
    close(sparse(th._neg_view(x)), dense(-x))


def test_under_autocast_sparse_layers_stay_float32():
    dense, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    mixed = nn.Sequential(dense[0], *list(sparse)[1:])
    x = th.randn(7, 5)
    with th.autocast("cpu", dtype=th.bfloat16):
        y = mixed(x)
    assert y.dtype == th.float32
    np.testing.assert_allclose(y.detach(), dense(x).detach(), atol=0.05)


def test_torchs_defaults_change_nothing():
    dense, sparse = networks([5, 8, 3], ["some"], nn.Tanh, True, 0)
    x = th.randn(7, 5)
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


def test_connections_that_change_between_the_passes_are_noticed():
    _, sparse = networks([5, 8, 3], ["full"], nn.ReLU, True, 0)
    y = sparse(th.randn(7, 5))
    sparse[0].restructure(Structure(np.arange(4), (8, 5)), th.ones(4))
    with pytest.raises(RuntimeError, match="connections have changed between"):
        y.sum().backward()


def test_layers_that_become_sparse_later_join_the_chain():
    dense, _ = networks([5, 8, 7, 3], ["some"], nn.ReLU, True, 0)
    sequence = copy.deepcopy(dense)
    x = th.randn(70, 5)
    for i in (2, 0, 4):
        mask = dense[i].mask
        SparseLinear.convert(sequence[i], Structure.of_mask(mask, mask.shape), is_target=False)
        chain_up(sequence)
        close(sequence(x), dense(x))
    assert len(sequence._split.steps) == 1


def test_no_nan_is_seen_where_there_is_none():
    _, sparse = networks([5, 8, 3], ["some"], nn.Tanh, True, 0)
    th.use_deterministic_algorithms(True)  # fills what is not written with NaN
    try:
        with th.autograd.detect_anomaly(check_nan=True):
            sparse(th.randn(100, 5)).sum().backward()
    finally:
        th.use_deterministic_algorithms(False)


def test_what_is_hooked_everywhere_is_called_by_itself():
    dense, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    shapes = []
    handle = nn.modules.module.register_module_forward_hook(
        lambda module, inputs, y: shapes.append(tuple(y.shape))
    )
    sparse(th.randn(7, 5))
    handle.remove()
    assert shapes == [(7, 8), (7, 8), (7, 3), (7, 3)]


def test_weights_that_the_kernels_cannot_read_are_rejected():
    _, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    sparse[0].bias.data = th.zeros(16)[::2]
    with pytest.raises(UnsupportedError, match="must be contiguous float32"):
        sparse(th.randn(7, 5))


def chained(*modules: nn.Module) -> nn.Sequential:
    sequence = nn.Sequential(*modules)
    chain_up(sequence)
    return sequence


def test_a_batch_goes_through_while_another_thread_moves_connections():
    x = th.ones(20, 300)
    found, allowed = largest_while_moving(
        (50, 300), (0.5, 0.01), lambda layer: lambda: layer(x), threads=1
    )
    assert set(found) <= allowed


def test_a_thread_may_call_while_another_finds_the_chains(monkeypatch):
    _, sparse = networks([5, 8, 3], ["some"], nn.ReLU, True, 0)
    expected, found, x = sparse(th.ones(7, 5)), [], th.ones(7, 5)
    chain_up(sparse)  # it looks for chains anew

    def meanwhile(module: nn.Module, name: str, value: object) -> None:
        vars(module)[name] = value
        thread = threading.Thread(target=lambda: found.append(sparse(x)))
        thread.start()
        thread.join()

    monkeypatch.setattr(ChainedSequential, "__setattr__", meanwhile)
    close(sparse(x), expected)
    assert found
    for y in found:
        close(y, expected)


def test_a_call_goes_on_while_another_thread_forgets_the_chains(monkeypatch):
    _, sparse = networks([5, 8, 3], ["some"], nn.LeakyReLU, True, 0)
    x = th.ones(7, 5)
    expected, forgotten = sparse(x), []

    def meanwhile(module: nn.Module) -> bool:
        if not forgotten:
            sparse.forget()
            forgotten.append(module)
        return tells_its_slope(module)

    monkeypatch.setattr("sb3_sparse.engine.sequential.tells_its_slope", meanwhile)
    close(sparse(x), expected)
    assert forgotten
