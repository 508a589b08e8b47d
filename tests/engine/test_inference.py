"""Networks in one call of the kernels against their modules, called one by one."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import numpy as np
import pytest
import torch as th
from engine_support import largest_while_moving
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from sb3_sparse.engine.activations import ACTIVATIONS
from sb3_sparse.engine.gaussian import sample_gaussian, sample_squashed
from sb3_sparse.engine.inference import Inference
from sb3_sparse.engine.kept import KeptInference
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.native import library
from sb3_sparse.engine.structure import Structure
from sb3_sparse.policies.contrib import SoundBatchRenorm1d

ELEMENTWISE = [
    *(kind for kind in ACTIVATIONS if kind is not nn.GELU),
    partial(nn.ELU, 1.7),
    partial(nn.CELU, 0.6),
    nn.GELU,
    partial(nn.GELU, "tanh"),
    partial(nn.Softplus, 2.0, 5.0),
    partial(nn.LeakyReLU, 0.2),
    partial(nn.Hardtanh, -0.5, 0.75),
]
STORAGES = ("plain", "masked", "sparse")


def stored(layer: nn.Linear, storage: str, density: float, random: np.random.Generator):
    """The layer under a random mask, kept in one of the storages."""
    mask = random.random(tuple(layer.weight.shape)) < density
    if storage == "plain":
        return layer
    if storage == "masked":
        masked = MaskedStorage("layer", layer)
        masked.set_mask(mask)
        return layer
    with th.no_grad():
        layer.weight.mul_(th.from_numpy(mask))
    return SparseLinear.convert(layer, Structure.of_mask(mask, mask.shape), is_target=False)


def dense_twin(layer: nn.Linear) -> nn.Linear:
    twin = nn.Linear(layer.in_features, layer.out_features, bias=layer.bias is not None).double()
    dense = layer.dense() if isinstance(layer, SparseLinear) else layer.weight
    with th.no_grad():
        twin.weight.copy_(dense)
        if layer.bias is not None:
            twin.bias.copy_(layer.bias)
    return twin


def by_modules(network: nn.Sequential, x: th.Tensor) -> th.Tensor:
    """In double precision, dense."""
    modules = (dense_twin(m) if isinstance(m, nn.Linear) else m for m in network)
    return nn.Sequential(*modules)(x.double()).detach()


def network(widths, storages, activation, density=0.4, bias=True, seed=0) -> nn.Sequential:
    random = np.random.default_rng(seed)
    th.manual_seed(seed)
    modules: list[nn.Module] = []
    for i, (columns, rows) in enumerate(zip(widths, widths[1:], strict=False)):
        layer = nn.Linear(columns, rows, bias=bias)
        modules.append(stored(layer, storages[i % len(storages)], density, random))
        modules.append(activation())
    return nn.Sequential(*modules[:-1])


def close(ours: th.Tensor, theirs: th.Tensor) -> None:
    assert ours.dtype == th.float32
    scale = 1e-6 * (1 + theirs.abs().max())
    np.testing.assert_allclose(ours, theirs, rtol=2e-6, atol=4 * float(scale))


@settings(deadline=None, max_examples=60)
@given(
    widths=st.lists(st.integers(1, 70), min_size=2, max_size=4),
    storages=st.lists(st.sampled_from(STORAGES), min_size=1, max_size=3),
    activation=st.sampled_from(ELEMENTWISE),
    density=st.sampled_from([0.0, 0.05, 0.4, 1.0]),
    bias=st.booleans(),
    batch=st.integers(1, 16),
    instructions=st.sampled_from(library.instruction_sets()),
    seed=st.integers(0, 1000),
)
def test_any_network_of_any_storage_gives_what_its_modules_give(
    widths, storages, activation, density, bias, batch, instructions, seed
):
    before = library.in_use()
    library.use(instructions)
    try:
        net = network(widths, storages, activation, density, bias, seed)
        x = 2 * th.randn(batch, widths[0])
        (ours,) = Inference.of([[net]])(x)
    finally:
        library.use(before)
    close(ours, by_modules(net, x))


@pytest.mark.parametrize("activation", ELEMENTWISE)
def test_every_activation_is_torchs_from_end_to_end_of_its_range(instructions, activation):
    points = th.cat([th.linspace(-90, 90, 1000), th.linspace(-1.5, 1.5, 1000), th.zeros(1)])
    layer = nn.Linear(1, len(points))
    with th.no_grad():
        layer.weight.copy_(points[:, None])
        layer.bias.zero_()
    (ours,) = Inference.of([[layer, activation()]])(th.ones(1, 1))
    np.testing.assert_allclose(
        ours[0], activation()(points.double()), rtol=2e-6, atol=4e-7, err_msg=str(activation)
    )


def renormalised() -> nn.Sequential:
    """Norms with running statistics, before the first layer and between two."""
    th.manual_seed(0)
    first, second = SoundBatchRenorm1d(5), SoundBatchRenorm1d(7)
    for norm in (first, second):
        for tensor in (norm.scale, norm.bias, norm.ra_mean, norm.ra_var):
            nn.init.uniform_(tensor, 0.1, 2.0)
    return nn.Sequential(first, nn.Linear(5, 7), nn.ReLU(), second, nn.Linear(7, 2)).eval()


@pytest.mark.parametrize("count", [1, 3, 16])
def test_batch_renorm_uses_its_running_statistics(count, instructions):
    net, x = renormalised(), th.randn(count, 5)
    found = Inference.of([[net]])
    for number in (1.0, 3.0):
        net[3].ra_mean[2] = number  # in place, as a gradient step moves it
        (result,) = found(x)
        close(result, copy.deepcopy(net).double()(x.double()).detach())


def test_a_norm_that_learns_statistics_is_called():
    net, x = renormalised(), th.randn(4, 5)
    found = Inference.of([[net]])
    net[3].train()
    assert found(x) is None
    net[3].eval()
    assert found(x) is not None
    net[0].affine = False
    assert found(x) is None


def test_heads_share_their_trunk(instructions):
    trunk = network([5, 8, 9], ["sparse"], nn.Tanh)
    heads = nn.Linear(9, 2), nn.Linear(9, 3)
    other = nn.Linear(5, 4)
    found = Inference.of([[trunk, heads[0]], [trunk, heads[1]], [other]])
    x = th.randn(3, 5)
    assert len(found._steps) == 5
    results = found(x)
    for ours, path in zip(results, ([trunk, heads[0]], [trunk, heads[1]], [other]), strict=True):
        flat = [m for p in path for m in (p if isinstance(p, nn.Sequential) else [p])]
        close(ours, by_modules(nn.Sequential(*flat), x))


@pytest.mark.parametrize(
    "modules",
    [
        [nn.Linear(3, 3), nn.LayerNorm(3)],
        [nn.Linear(3, 3), nn.Dropout()],
        [nn.Tanh(), nn.Linear(3, 3)],
        [nn.Linear(3, 3), nn.Tanh(), nn.Tanh()],
        [nn.Linear(3, 3), nn.PReLU()],
        [type("Own", (nn.Linear,), {})(3, 3)],
        [type("OwnSequential", (nn.Sequential,), {})(nn.Linear(3, 3))],
        [],
    ],
)
def test_other_modules_are_called_one_by_one(modules):
    assert Inference.of([modules]) is None


@pytest.mark.parametrize(
    "x",
    [
        th.randn(17, 5),
        th.randn(0, 5),
        th.randn(2, 4),
        th.randn(5),
        th.randn(2, 1, 5),
        th.randn(2, 5).double(),
        th.full((1, 5), th.nan),
        th.full((1, 5), th.inf),
    ],
)
def test_inputs_that_it_does_not_take_and_results_without_end_are_left_to_the_modules(x):
    assert Inference.of([[network([5, 4, 3], ["masked"], nn.ReLU)]])(x) is None


def test_a_module_counts_as_often_as_it_is_called():
    twice, tanh = nn.Linear(6, 6), nn.Tanh()
    net = nn.Sequential(twice, tanh, nn.Sequential(nn.Linear(6, 6), tanh, twice), tanh)
    x = th.randn(3, 6)
    (ours,) = Inference.of([[net]])(x)
    close(ours, net(x).detach())


def test_whoever_watches_gets_the_modules():
    net = network([5, 4, 3], ["sparse", "masked"], nn.Tanh)
    found = Inference.of([[net]])
    x = th.randn(2, 5)
    for module in (net[0], net[1]):
        for hook in (module.register_forward_hook, module.register_forward_pre_hook):
            handle = hook(lambda *_: None)
            assert found(x) is None
            handle.remove()
            assert found(x) is not None
    with th.autocast("cpu", dtype=th.bfloat16):
        assert found(x) is None
    handle = nn.modules.module.register_module_forward_hook(lambda *_: None)
    assert found(x) is None
    handle.remove()
    assert th.func.vmap(lambda row: th.zeros(1) if found(row[None]) is None else row)(x).sum() == 0
    assert found(x) is not None


def test_an_input_that_is_not_contiguous_is_read_right():
    net = network([5, 4, 3], ["sparse"], nn.Tanh)
    x = th.randn(5, 4).T
    close(Inference.of([[net]])(x)[0], by_modules(net, x))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 4, 16])
def test_observations_of_any_shape_are_flattened_and_rounded(kind, count, instructions):
    net = network([6, 4, 3], ["sparse", "masked"], nn.Tanh)
    found = Inference.of([[net]])
    x = np.random.default_rng(0).normal(size=(count, 2, 3)).astype(kind)
    expected = by_modules(net, th.from_numpy(x).float().flatten(1))
    close(found.of_observations(th.from_numpy(x))[0], expected)
    close(th.from_numpy(found.of_array(x)[0]), expected)
    turned = np.asfortranarray(x)
    close(th.from_numpy(found.of_array(turned)[0]), expected)
    close(found.of_observations(th.from_numpy(turned))[0], expected)


@pytest.mark.parametrize(
    "x",
    [
        np.ones((0, 5), np.float32),
        np.ones((17, 5), np.float32),
        np.ones((2, 4), np.float32),
        np.ones((2, 5), int),
        np.full((2, 5), np.nan, np.float32),
        np.full((2, 5), 1e300),
    ],
)
def test_arrays_that_it_does_not_take_are_left_to_the_modules(x):
    found = Inference.of([[network([5, 4, 3], ["masked"], nn.ReLU)]])
    assert found.of_array(x) is None
    with th.inference_mode():
        assert found.of_array(np.ones((2, 5), np.float32)) is not None
    with th.autocast("cpu"):
        assert found.of_array(np.ones((2, 5), np.float32)) is None


def write(net):
    with th.no_grad():
        net[0].weight.mul_(3)
        net[2].bias.add_(1)


def new_data(net):
    net[2].weight.data = net[2].weight.data * 2
    net[0].bias.data = net[0].bias.data + 1


def move(net):
    layer = net[0]
    if isinstance(layer, SparseLinear):
        dense = layer.dense()
        layer.take(
            Structure.of_mask(dense.numpy() == 0, layer.structure.shape), th.ones_like(dense)
        )
    else:
        mask = MaskedStorage.of(layer)
        mask.set_mask(~mask.mask())
        mask.write(th.ones(layer.weight.shape))


def exchange(net):
    net[1] = nn.ReLU()


def new_layer(net):
    net[2] = nn.Linear(6, 3)


def new_parameter(net):
    net[2].bias = nn.Parameter(th.ones(3))


def steeper(net):
    net[1].alpha = 4.0


@pytest.mark.parametrize("storage", ["masked", "sparse"])
@pytest.mark.parametrize(
    "change", [write, new_data, move, exchange, new_layer, new_parameter, steeper]
)
def test_it_follows_every_change(storage, change):
    net = network([5, 6, 3], [storage], partial(nn.ELU, 1.5))
    kept = KeptInference()
    x = th.randn(2, 5)

    def now() -> th.Tensor:
        return kept.get(lambda: ([[net]], [net]))(x)[0].clone()

    before = now()
    change(net)
    assert not th.equal(now(), before)
    close(now(), by_modules(net, x))


def test_a_parameter_of_an_activation_that_was_zero_is_followed():
    net = nn.Sequential(nn.Linear(3, 3), nn.LeakyReLU(0.0))
    found = Inference.of([[net]])
    x = th.randn(4, 3)
    found(x)
    net[1].negative_slope = 0.5
    close(found(x)[0], by_modules(net, x))


def test_a_square_weight_that_is_transposed_in_place_is_not_misread():
    layer = nn.Linear(4, 4)
    found = Inference.of([[layer]])
    assert found(th.randn(1, 4)) is not None
    layer.weight.data = layer.weight.data.T
    assert found(th.randn(1, 4)) is None


def test_what_is_inactive_counts_as_zero_whoever_wrote_it(instructions):
    net = network([5, 6, 3], ["masked"], nn.Tanh)
    x = th.randn(4, 5)
    expected = by_modules(net, x)
    for layer in (net[0], net[2]):
        inactive = MaskedStorage.of(layer).float_mask == 0
        layer.weight.data[inactive] = th.tensor([th.nan, th.inf, 3.0]).repeat(30)[: inactive.sum()]
    for batch in (1, 4):
        close(Inference.of([[net]])(x[:batch])[0], expected[:batch])


def test_modules_that_take_over_see_no_inactive_weight_either():
    net = network([5, 6, 3], ["masked"], nn.Tanh)
    net[0].weight.data.add_(1.0)
    assert Inference.of([[net]])(th.full((1, 5), th.nan)) is None
    assert (net[0].weight[MaskedStorage.of(net[0]).float_mask == 0] == 0).all()


def test_copies_and_pickles_begin_empty():
    net = network([5, 6, 3], ["sparse"], nn.Tanh)
    kept = KeptInference()
    assert kept.get(lambda: ([[net]], [net])) is not None
    for twin in (copy.deepcopy(kept), pickle.loads(pickle.dumps(kept))):
        assert vars(twin) == vars(KeptInference())


@given(
    mean=st.floats(-50, 50, width=32),
    log_std=st.floats(-15, 10, width=32),
    noise=st.floats(-4, 4, width=32),
)
def test_gaussian_actions_and_log_probabilities_are_those_of_the_formula(mean, log_std, noise):
    means = th.tensor([[mean, 0.5, -1.0], [0.0, 0.0, 0.0]])
    noises = th.tensor([[noise, 0.0, 1.0], [0.5, -0.5, 2.0]])
    log_stds = th.tensor([log_std, 0.0, -1.0])
    taken, log_probs = sample_gaussian(means, log_stds, noises)
    actions = means + log_stds.exp() * noises
    np.testing.assert_allclose(taken, actions, rtol=1e-6, atol=1e-6)
    taken = taken.double()
    std = log_stds.double().exp()
    density = th.exp(-0.5 * ((taken - means) / std) ** 2) / (std * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(log_probs, density.log().sum(dim=1), rtol=1e-5, atol=1e-4)


def test_a_gaussian_without_end_is_reported():
    assert sample_gaussian(th.zeros(1, 1), th.tensor([-200.0]), None) is None
    assert sample_gaussian(th.full((1, 1), th.nan), th.zeros(1), None) is None
    assert sample_gaussian(th.zeros(1, 1), th.zeros(1), None) is not None


@given(
    mean=st.floats(-50, 50, width=32),
    log_std=st.floats(-30, 10, width=32),
    noise=st.floats(-4, 4, width=32),
)
def test_squashed_actions_are_those_of_the_formula(mean, log_std, noise):
    means, noises = th.tensor([[mean, 0.5]]), th.tensor([[noise, -1.0]])
    log_stds = th.tensor([[log_std, 0.1]])
    bounded = log_stds.clamp(-20, 2)
    made = sample_squashed(means, log_stds, (-20, 2), noises)
    assert th.equal(log_stds, bounded)
    before = means + bounded.exp() * noises
    np.testing.assert_allclose(made[0], before, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(made[1], before.tanh(), rtol=1e-6, atol=1e-6)
    made = sample_squashed(means, log_stds, (-20, 2), None)
    np.testing.assert_allclose(th.stack(made), th.stack([means, means.tanh()]), rtol=1e-6)
    assert sample_squashed(th.full((1, 2), th.nan), log_stds, (-20, 2), None) is None


def test_layers_that_do_not_fit_each_other_are_left_to_the_modules():
    net = nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(5, 2))
    assert Inference.of([[net]]) is None


@pytest.mark.parametrize("storage", ["masked", "sparse"])
def test_weights_of_another_size_are_never_read(storage):
    net = network([5, 6, 3], [storage], nn.Tanh)
    found = Inference.of([[net]])
    x = th.randn(2, 5)
    assert found(x) is not None
    whole = net[2].weight.data
    net[2].weight.data = whole.reshape(-1)[:2]
    assert found._bound() is None
    net[2].weight.data = whole
    assert found(x) is not None


def test_a_target_that_awaits_its_copy_is_left_to_its_module():
    layer = nn.Linear(4, 3)
    dense = layer.weight.detach().clone()
    mask = np.arange(12) % 2 == 0
    target = SparseLinear.convert(layer, Structure.of_mask(mask, (3, 4)), is_target=True)
    assert target.snapshot is not None  # it still has weights that the mask has not
    found = Inference.of([[target]])
    assert found(th.randn(1, 4)) is None
    target.take(target.structure, dense)
    assert found(th.randn(1, 4)) is not None
    target.await_copy(Structure.of_mask(~mask, (3, 4)))
    assert found(th.randn(1, 4)) is None


def test_a_method_that_was_patched_is_called():
    net = network([5, 4, 3], ["sparse"], nn.Tanh)
    net[2].forward = lambda x: x[:, :3]
    assert Inference.of([[net]]) is None


def test_connections_that_another_thread_moves_are_never_read_halfway():
    def actor_of(layer):
        inference, x = Inference.of([[layer]]), th.ones(1, 2000)
        return lambda: inference(x)[0]

    found, allowed = largest_while_moving((500, 2000), (0.3, 0.001), actor_of, threads=2)
    assert set(found) <= allowed


def test_what_the_kernels_cannot_read_costs_no_waiting():
    net = network([5, 6, 3], ["sparse", "plain"], nn.Tanh)
    net[2].double()
    found = Inference.of([[net]])
    x = th.randn(1, 5)
    tries = []
    bind = found._arguments
    found._arguments = lambda *given: tries.append(1) or bind(*given)
    assert found(x) is None
    assert tries == [1]
