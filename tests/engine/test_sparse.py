"""The sparse storage beside the masked one: same moves, same moments, same saved form."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_sparse.engine.internals import replace_data
from sb3_sparse.engine.layer import Snapshot
from sb3_sparse.engine.linear import SparseLinear
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.sparse import SparseStorage, storable, to_sparse
from sb3_sparse.errors import CorruptStateError, TopologyError, UnsupportedError
from sb3_sparse.topology import Exchange

SIZE = 24


class Kind(NamedTuple):
    """A kind of layer with 24 connections.

    :param make: makes one
    :param shape: of its weight
    :param input: shape of one input
    :param weight_grad: the gradient of its weight, of inputs and output gradients
    """

    make: Callable[[], nn.Module]
    shape: tuple[int, ...]
    input: tuple[int, ...]
    weight_grad: Callable[[th.Tensor, th.Tensor], th.Tensor]


LINEAR = Kind(lambda: nn.Linear(6, 4), (4, 6), (6,), lambda x, g: g.T @ x)
CONVOLUTION = Kind(
    lambda: nn.Conv2d(3, 4, (2, 1), stride=(1, 2), padding=(1, 0)),
    (4, 3, 2, 1),
    (3, 3, 4),
    lambda x, g: nn.grad.conv2d_weight(x, (4, 3, 2, 1), g, stride=(1, 2), padding=(1, 0)),
)


@pytest.fixture(scope="module", params=[LINEAR, CONVOLUTION], ids=["linear", "convolution"])
def kind(request) -> Kind:
    return request.param


def twins(
    kind: Kind, seed: int = 0, target: bool = True, optimizer=th.optim.Adam
) -> list[SimpleNamespace]:
    """The same layer, its target and its optimizer, masked and sparse."""
    found = []
    for sparse in (False, True):
        th.manual_seed(seed)
        module, copied = kind.make(), kind.make()
        layer = MaskedStorage("layer", module)
        layer.set_mask(np.random.default_rng(seed).random(kind.shape) < 0.5)
        layer.final_nnz = 1  # so masks of any count fit, as where pruning is under way
        if target:
            layer.add_target(copied)
        made = optimizer(module.parameters(), lr=0.1)
        if sparse:
            layer = SparseStorage(layer, [made])
        side = SimpleNamespace(kind=kind, layer=layer, module=module, target=copied, optimizer=made)
        found.append(side)
    return found


def step(side: SimpleNamespace, seed: int = 0) -> th.Tensor:
    """One step on a random loss; the dense gradient of the weight."""
    random = th.Generator().manual_seed(seed)
    x = th.randn(5, *side.kind.input, generator=random)
    side.optimizer.zero_grad()
    y = side.module(x)
    g = th.randn(y.shape, generator=random)
    y.backward(g)
    if not side.layer.is_sparse:
        side.module.weight.grad.mul_(side.layer.float_mask)
    side.optimizer.step()
    return side.kind.weight_grad(x, g)


def exchange_of(layer, drop: int, grow: int, seed: int = 0) -> Exchange:
    random, mask = np.random.default_rng(seed), layer.mask()
    active, inactive = np.flatnonzero(mask), np.flatnonzero(~mask)
    return Exchange(
        np.sort(random.choice(active, min(drop, active.size - 1), replace=False)),
        np.sort(random.choice(inactive, min(grow, inactive.size), replace=False)),
    )


def moments(side: SimpleNamespace) -> list[np.ndarray]:
    state = side.optimizer.state[side.module.weight]
    return [side.layer.saved_moment(v).numpy() for v in state.values() if v.dim()]


def same(masked: SimpleNamespace, sparse: SimpleNamespace) -> None:
    ours, theirs = sparse.layer, masked.layer
    assert ours.nnz == theirs.nnz == int(theirs.mask().sum())
    np.testing.assert_array_equal(ours.mask(), theirs.mask())
    np.testing.assert_allclose(ours.dense(), theirs.dense(), rtol=1e-5, atol=5e-7)
    for one, other in zip(moments(masked), moments(sparse), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-7)
    for name in ("module", "target"):
        one, other = getattr(masked, name).state_dict(), getattr(sparse, name).state_dict()
        assert list(one) == list(other)
        for key in one:
            assert one[key].dtype == other[key].dtype
            np.testing.assert_allclose(other[key], one[key], rtol=1e-5, atol=5e-7, err_msg=key)
    if masked.module.weight.grad is not None:
        expected = masked.module.weight.grad.reshape(-1)[theirs.mask()]
        found = sparse.module.weight.grad
        found = found if ours.is_sparse else found.reshape(-1)[ours.mask()]
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 99),
    moves=st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=4),
    soft=st.booleans(),
    dense=st.booleans(),
    optimizer=st.sampled_from([th.optim.Adam, th.optim.RMSprop, th.optim.SGD]),
)
def test_any_moves_leave_both_storages_alike(kind, seed, moves, soft, dense, optimizer):
    masked, sparse = sides = twins(kind, seed, optimizer=optimizer)
    for i, (drop, grow) in enumerate(moves):
        gradients = [step(side, i) for side in sides]
        exchange = exchange_of(masked.layer, drop, grow, i)
        for side, gradient in zip(sides, gradients, strict=True):
            side.layer.move(
                exchange,
                [side.optimizer],
                soft_targets=soft,
                dense_grad=gradient if dense else None,
            )
        same(masked, sparse)
        for side in sides:
            tau = 0.5 if soft else 1.0
            if soft or i % 2:
                polyak_update(side.module.parameters(), side.target.parameters(), tau)
        same(masked, sparse)


def test_the_parameter_holds_the_active_values_by_rows(kind):
    masked, sparse = twins(kind)
    assert sparse.module.weight.shape == (masked.layer.nnz,)
    assert isinstance(sparse.module, type(masked.module))
    assert sparse.module.dense_shape == sparse.layer.shape == kind.shape
    np.testing.assert_array_equal(
        sparse.module.weight.detach(), masked.layer.dense()[masked.layer.mask()]
    )


def test_a_hard_target_computes_with_its_snapshot_until_it_is_copied(kind):
    _, side = twins(kind)
    before = side.target.dense()
    x = th.randn(3, *kind.input)
    with th.no_grad():
        expected = side.target(x)
        side.layer.move(exchange_of(side.layer, 4, 2), soft_targets=False)
        assert side.target.weight.shape == (side.layer.nnz,)
        kept = before.reshape(-1)[side.layer.mask()]
        np.testing.assert_array_equal(side.target.weight, kept)
        np.testing.assert_array_equal(side.target(x), expected)
        side.layer.move(exchange_of(side.layer, 1, 3, seed=1), soft_targets=False)
        np.testing.assert_array_equal(side.target.dense(), before)
    step(side)
    with th.no_grad():
        polyak_update(side.module.parameters(), side.target.parameters(), 1.0)
        np.testing.assert_array_equal(side.target(x), side.module(x))
    assert side.target.snapshot is None


def test_whoever_writes_a_hard_target_after_a_move_ends_its_snapshot_with_finite_weights(kind):
    _, side = twins(kind)
    before = side.target.dense().reshape(-1).numpy()
    side.layer.move(exchange_of(side.layer, 4, 2), soft_targets=False)
    step(side)
    kept = before * side.layer.mask()
    with th.no_grad():
        polyak_update(side.module.parameters(), side.target.parameters(), 0.25)
    blended = 0.75 * kept + 0.25 * side.layer.dense()
    np.testing.assert_allclose(side.target.dense().reshape(-1), blended, rtol=1e-6)
    side.layer.move(exchange_of(side.layer, 2, 2, seed=1), soft_targets=False)
    side.target.weight.data.clamp_(-0.01, 0.01)
    clamped = np.clip(blended * side.layer.mask(), -0.01, 0.01)
    np.testing.assert_allclose(side.target.dense().reshape(-1), clamped, rtol=1e-6)


def test_a_target_with_weights_outside_the_mask_keeps_them_when_loaded(kind):
    _, side = twins(kind)
    dense = {k: th.randn_like(v) for k, v in kind.make().state_dict().items()}
    side.target.load_state_dict(dense)
    np.testing.assert_array_equal(side.target.state_dict()["weight"], dense["weight"])
    kept = dense["weight"].reshape(-1)[side.layer.mask()]
    np.testing.assert_array_equal(side.target.weight.detach(), kept)
    side.layer.mask_targets()
    np.testing.assert_array_equal(
        side.target.dense().reshape(-1), dense["weight"].numpy().ravel() * side.layer.mask()
    )


def test_a_mask_of_another_layer_is_taken_over_with_moments_and_targets(kind):
    masked, sparse = twins(kind)
    for side in (masked, sparse):
        step(side)
    other = twins(kind, seed=5)[0]
    for side in (masked, sparse):
        side.optimizer.zero_grad()
        side.module.load_state_dict(other.module.state_dict())
        assert side.layer.moments_stale
        side.layer.settle_moments([side.optimizer])
        side.layer.mask_targets()
    same(masked, sparse)


@pytest.mark.parametrize("first", ["module", "optimizer"])
def test_either_storage_takes_up_what_the_other_saved(kind, first):
    masked, sparse = twins(kind)
    step(masked)
    masked.optimizer.zero_grad()
    saved = copy.deepcopy((masked.module.state_dict(), masked.optimizer.state_dict()))
    fresh = twins(kind, seed=7)[1]
    for what in (first, *({"module", "optimizer"} - {first})):
        if what == "module":
            fresh.module.load_state_dict(saved[0])
        else:
            fresh.optimizer.load_state_dict(saved[1])
    fresh.target.load_state_dict(masked.target.state_dict())
    fresh.layer.settle_moments([fresh.optimizer])
    same(masked, fresh)
    step(masked, 1)
    step(fresh, 1)
    same(masked, fresh)


def test_loaded_moments_follow_a_move_that_comes_before_any_step(kind):
    other = twins(kind, seed=5)[0]
    step(other, 3)
    masked, sparse = twins(kind)
    for side in (masked, sparse):
        step(side)
        side.optimizer.zero_grad()
        side.module.load_state_dict(other.module.state_dict())
        side.optimizer.load_state_dict(copy.deepcopy(other.optimizer.state_dict()))
    exchange = exchange_of(masked.layer, 3, 2)
    for side in (masked, sparse):
        side.layer.move(exchange, [side.optimizer])
    same(masked, sparse)


def test_weights_without_a_mask_are_masked(kind):
    _, sparse = twins(kind)
    dense = kind.make().state_dict()
    with pytest.raises(RuntimeError, match='Missing key.*"weight_mask"'):
        sparse.module.load_state_dict(dense)
    sparse.module.load_state_dict(dense, strict=False)
    mask = sparse.layer.mask()
    np.testing.assert_array_equal(sparse.layer.dense(), dense["weight"].numpy().ravel() * mask)


def test_an_exchange_that_does_not_fit_is_rejected_and_changes_nothing(kind):
    _, sparse = twins(kind)
    before = sparse.layer.mask()
    active = np.flatnonzero(before)
    with pytest.raises(TopologyError, match="some of the grown are"):
        sparse.layer.move(Exchange(active[:1], active[1:2]))
    np.testing.assert_array_equal(sparse.layer.mask(), before)


def test_wrong_shapes_and_empty_masks_are_rejected_at_load(kind):
    _, sparse = twins(kind)
    saved = sparse.module.state_dict()
    with pytest.raises(RuntimeError, match=r"size mismatch for weight: .*\(4, 5\)"):
        sparse.module.load_state_dict({**saved, "weight": th.zeros(4, 5)})
    with pytest.raises(RuntimeError, match="size mismatch for weight_mask"):
        sparse.module.load_state_dict({**saved, "weight_mask": th.ones(3).bool()})
    with pytest.raises(CorruptStateError, match=f"has 0 of {SIZE} connections"):
        sparse.module.load_state_dict({**saved, "weight_mask": th.zeros(kind.shape).bool()})
    with pytest.raises(RuntimeError, match="Missing key"):
        sparse.module.load_state_dict({k: v for k, v in saved.items() if k != "weight"})


def test_copies_are_independent(kind):
    _, sparse = twins(kind)
    twin = copy.deepcopy(sparse)
    step(twin)
    twin.layer.move(exchange_of(twin.layer, 3, 3), [twin.optimizer])
    assert twin.layer.module is twin.module
    assert (twin.layer.mask() != sparse.layer.mask()).any()
    fresh = twins(kind)[1]
    np.testing.assert_array_equal(sparse.layer.dense(), fresh.layer.dense())


def test_pickles_of_earlier_versions_find_their_classes():
    for name in ("SparseLinear", "Snapshot"):
        found = pickle.loads(f"csb3_sparse.engine.linear\n{name}\n.".encode())
        assert found in (SparseLinear, Snapshot)


def test_a_parameter_may_change_its_size_while_an_older_graph_is_alive():
    weight = nn.Parameter(th.ones(5))
    loss = weight.square().sum()
    loss.backward()
    replace_data(weight, th.full((3,), 2.0))
    newer = weight.square().sum()
    newer.backward()
    assert weight.grad.tolist() == [4.0] * 3
    assert loss.grad_fn is not None


@pytest.mark.parametrize(
    "module",
    [
        nn.Conv2d(2, 4, 3, dilation=2),
        nn.Conv2d(2, 4, 3, groups=2),
        nn.Conv2d(2, 4, 3, padding=1, padding_mode="circular"),
        nn.Conv2d(2, 4, 3, padding="same"),
        nn.Conv1d(2, 4, 3),
        nn.Conv3d(2, 4, 3),
        type("OwnConv2d", (nn.Conv2d,), {})(2, 4, 3),
        type("OwnLinear", (nn.Linear,), {})(2, 4),
    ],
    ids=str,
)
def test_all_other_layers_keep_their_masks(module):
    layer = MaskedStorage("layer", module)
    assert not storable(module)
    assert to_sparse(layer, []) is layer


def test_linear_layers_and_plain_convolutions_become_sparse(kind):
    module = kind.make()
    assert storable(module)
    before = type(module), module.weight
    layer = to_sparse(MaskedStorage("layer", module), [])
    assert layer.is_sparse
    assert to_sparse(layer, []) is layer
    assert not storable(module)
    again = layer.to_masked([])
    assert again.module is module
    assert (type(module), module.weight) == before
    assert module.weight.shape == kind.shape


def test_going_back_to_masks_keeps_masks_weights_targets_and_moments(kind):
    masked, sparse = sides = twins(kind)
    for side in sides:
        step(side)
        side.layer.move(exchange_of(side.layer, 3, 2), [side.optimizer], soft_targets=False)
        side.optimizer.zero_grad()
    sparse.layer = sparse.layer.to_masked([sparse.optimizer])
    assert vars(sparse.module).keys() == vars(masked.module).keys()
    same(masked, sparse)
    for side in sides:
        step(side, 1)
    same(masked, sparse)


def test_own_initialisation_sees_the_dense_weight_and_inactive_ones_stay_absent(kind):
    _, sparse = twins(kind)
    seen = []

    def fill(module: nn.Module) -> None:
        seen.append(tuple(module.weight.shape))
        nn.init.ones_(module.weight)

    mask = sparse.layer.mask()
    assert sparse.module.apply(fill) is sparse.module
    assert seen == [kind.shape]
    np.testing.assert_array_equal(sparse.layer.dense(), mask)
    th.manual_seed(5)
    fresh = kind.make()
    th.manual_seed(5)
    sparse.module.reset_parameters()
    np.testing.assert_array_equal(
        sparse.layer.dense(), fresh.weight.detach().numpy().ravel() * mask
    )
    np.testing.assert_array_equal(sparse.module.bias.detach(), fresh.bias.detach())


def test_pickles_hold_the_layer_and_a_copy_computes_the_same(kind):
    _, sparse = twins(kind)
    x = th.randn(2, *kind.input)
    for module in (sparse.module, sparse.target):
        loaded = pickle.loads(pickle.dumps(module))
        assert type(loaded) is type(module)
        np.testing.assert_array_equal(loaded(x).detach(), module(x).detach())
        assert loaded.state_dict().keys() == module.state_dict().keys()


@pytest.mark.parametrize("where", [th.float64, "meta"])
def test_only_float32_on_the_cpu(kind, where):
    _, sparse = twins(kind)
    with pytest.raises(UnsupportedError, match="make the policy with compute='masked'"):
        sparse.module.to(where)
    assert sparse.module.to("cpu") is sparse.module
