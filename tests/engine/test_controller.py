"""The mechanism on one 3x4 layer, against numbers worked out by hand."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from support import registered
from torch import nn

from sb3_sparse.engine.controller import Controller
from sb3_sparse.engine.network import SparseNetwork
from sb3_sparse.engine.plan import Plan
from sb3_sparse.engine.plans import Plans
from sb3_sparse.errors import TopologyError
from sb3_sparse.topology import Exchange, TopologyMethod

# Active: the first two columns. Least magnitudes: flat 5 (0.1), then 4 (0.2).
WEIGHTS = [[0.5, -0.6, 0.0, 0.0], [-0.2, 0.1, 0.0, 0.0], [0.7, -0.8, 0.0, 0.0]]
# Dense gradient. Of the inactive and the two dropped ones (2, 3, 4, 5, 6, 7, 10, 11) the largest
# are flat 7 (9.0) and flat 4 (8.0), which is one of the dropped: it stays.
GRADIENT = [[1.0, 1.0, 2.0, -3.0], [8.0, 0.5, 0.0, -9.0], [1.0, 1.0, 4.0, 5.0]]


def rig(method="rigl", optimizer=None, functional=False, **plan):
    """A network of one 3x4 layer with 6 of 12 active, and its controller."""
    owner = nn.Sequential(nn.Linear(4, 3, bias=False))
    owner.optimizer = (optimizer or (lambda p: th.optim.SGD(p, lr=1.0)))(owner.parameters())
    network = SparseNetwork("net", owner, [("0", owner[0])])
    layer = network.layers[0]
    layer.set_mask(np.tile([True, True, False, False], 3))
    layer.write(th.tensor(WEIGHTS))
    layer.final_nnz = layer.initial_nnz = 6
    controller = Controller([network], seed=1, functional_gradients=functional)
    controller.attach()
    settings = dict(update_interval=1, drop_fraction=1 / 3, begin=0.0, end=0.8, update_on="step")
    start(controller, Plan(method, **{**settings, **plan}))
    return owner, layer, controller


def start(controller, plan, in_force=lambda: True):
    controller.start(Plans(plan), soft_targets=True, in_force=in_force)


def step(owner, gradient=GRADIENT, clip=None):
    """One gradient step of a loss whose gradient is ``gradient``."""
    owner.optimizer.zero_grad()
    (owner[0].weight * th.tensor(gradient)).sum().backward()
    if clip is not None:
        nn.utils.clip_grad_norm_(owner.parameters(), clip)
    owner.optimizer.step()


@pytest.mark.parametrize("functional", [False, True])
def test_rigl_moves_as_by_hand_and_then_steps_under_the_new_mask(functional):
    owner, layer, _ = rig(functional=functional)
    step(owner)
    assert np.flatnonzero(layer.mask()).tolist() == [0, 1, 4, 7, 8, 9]
    # SGD with learning rate 1: kept weights minus their gradient; the grown one starts from 0.
    expected = [[-0.5, -1.6, 0.0, 0.0], [-8.2, 0.0, 0.0, 9.0], [-0.3, -1.8, 0.0, 0.0]]
    np.testing.assert_allclose(layer.dense().reshape(3, 4), expected, rtol=1e-6)


@pytest.mark.parametrize("functional", [False, True])
def test_a_clipped_gradient_has_the_active_norm_and_a_grown_connection_is_scaled_alike(functional):
    owner, layer, _ = rig(functional=functional)
    # Active entries: 1, 1, 8, 0.5, 1, 1; their norm is sqrt(68.25). Clipped to half of it.
    step(owner, clip=0.5 * 68.25**0.5)
    expected = [[0.0, -1.1, 0.0, 0.0], [-4.2, 0.0, 0.0, 4.5], [0.2, -1.3, 0.0, 0.0]]
    np.testing.assert_allclose(layer.dense().reshape(3, 4), expected, rtol=1e-4, atol=1e-6)


def test_moments_are_zeroed_on_drop_and_grow_and_kept_by_what_is_regrown():
    owner, layer, controller = rig(optimizer=lambda p: th.optim.Adam(p, lr=0.01))
    controller.drop_plans()
    step(owner, [[1.0] * 4] * 3)
    before = owner.optimizer.state[layer.weight]["exp_avg"].clone()
    assert before[1, 0] != 0
    assert not before[:, 2:].any()

    seen = {}

    def look(optimizer, args, kwargs):
        seen["exp_avg"] = optimizer.state[layer.weight]["exp_avg"].clone()
        seen["exp_avg_sq"] = optimizer.state[layer.weight]["exp_avg_sq"].clone()
        seen["weight"] = layer.weight.detach().clone()

    owner.optimizer.register_step_pre_hook(look)  # after ours: between the move and the step
    weight_before = layer.weight.detach().clone()
    plan = Plan("rigl", 1, 1 / 3, 0.0, 0.8, "step")
    start(controller, plan)
    step(owner)
    for moment in (seen["exp_avg"], seen["exp_avg_sq"]):
        assert moment.flatten()[5] == 0  # dropped
        assert moment.flatten()[7] == 0  # grown
    assert seen["exp_avg"].flatten()[4] == before.flatten()[4]  # dropped and regrown
    assert seen["weight"].flatten()[4] == weight_before.flatten()[4]
    assert seen["weight"].flatten()[7] == 0


def test_updates_come_every_interval_on_the_optimizers_own_clock():
    owner, layer, controller = rig("set", update_interval=3)
    masks = []
    for _ in range(7):
        step(owner, [[0.1, 0.2, 0.3, 0.4]] * 3)
        masks.append(layer.mask())
    changed = [i + 2 for i in range(6) if (masks[i] != masks[i + 1]).any()]
    assert changed == [3, 6]
    assert controller.networks[0].clock == 7
    assert controller.networks[0].mask_updates == 2


@pytest.mark.parametrize(
    ("progress", "moves"), [(0.0, False), (0.29, False), (0.3, True), (0.35, True), (0.6, False)]
)
def test_updates_happen_from_begin_and_before_end(progress, moves):
    owner, layer, controller = rig("set", begin=0.3, end=0.6, drop_fraction=1.0)
    before = layer.mask()
    controller.progress = progress
    step(owner)
    assert (layer.mask() != before).any() == moves


def test_set_grows_without_looking_at_the_gradient_and_the_same_again_for_the_same_seed():
    masks = []
    for gradient in (GRADIENT, [[0.0] * 4] * 3):
        owner, layer, _ = rig("set", drop_fraction=0.5)
        step(owner, gradient)
        masks.append(layer.mask())
        assert layer.nnz == 6
    np.testing.assert_array_equal(*masks)


def test_pruning_keeps_the_largest_and_ends_exact_even_between_two_intervals():
    owner, layer, controller = rig("prune", update_interval=1000, begin=0.2, end=0.8)
    layer.final_nnz = 3
    controller.progress = 0.5
    step(owner, [[0.0] * 4] * 3)
    assert layer.nnz == 6
    controller.progress = 0.8
    step(owner, [[0.0] * 4] * 3)
    assert np.flatnonzero(layer.mask()).tolist() == [1, 8, 9]  # 0.6, 0.7, 0.8


def test_pruning_is_finished_at_the_end_of_training_when_no_step_came_after_the_end():
    _, layer, controller = rig("prune", begin=0.2, end=0.8)
    layer.final_nnz = 2
    controller.progress = 1.0
    controller.stop()
    assert np.flatnonzero(layer.mask()).tolist() == [8, 9]


def test_pruned_stays_pruned_when_training_starts_over():
    owner, layer, controller = rig("prune", begin=0.2, end=0.8)
    layer.initial_nnz, layer.final_nnz = 12, 3
    controller.progress = 0.8
    step(owner)
    controller.progress = 0.3
    step(owner)
    assert layer.nnz == 3


def test_on_rollout_the_move_waits_and_uses_the_gradient_of_the_step_that_was_due():
    owner, layer, controller = rig(update_on="rollout", update_interval=2)
    calm = [[0.1] * 4] * 3
    step(owner, calm)
    step(owner, GRADIENT)  # due; weights move by SGD, the mask does not
    before = layer.mask()
    step(owner, calm)
    np.testing.assert_array_equal(layer.mask(), before)
    controller.flush()
    # By then the weights are -0.7, -1.8 | -8.4, -0.6 | -0.5, -2.0: the least are 0.5 (flat 8) and
    # 0.6 (flat 5); the largest gradients among 2, 3, 5, 6, 7, 8, 10, 11 are at 7 (9) and 11 (5).
    assert np.flatnonzero(layer.mask()).tolist() == [0, 1, 4, 7, 9, 11]
    masked = layer.mask()
    controller.flush()
    np.testing.assert_array_equal(layer.mask(), masked)


def test_an_update_left_waiting_by_an_interruption_is_forgotten():
    owner, layer, controller = rig(update_on="rollout")
    before = layer.mask()
    step(owner)
    start(controller, controller.networks[0].plan)
    controller.flush()
    np.testing.assert_array_equal(layer.mask(), before)


def test_a_gradient_of_another_loss_after_the_step_does_not_reach_the_next_growth():
    owner, layer, _ = rig()
    step(owner, [[0.0] * 4] * 3)
    stray = [[0.0, 0.0, 99.0, 99.0]] * 3
    (owner[0].weight * th.tensor(stray)).sum().backward()
    step(owner)
    # Only GRADIENT decides; the first step regrew what it dropped, ties to the lowest index.
    twin, twin_layer, _ = rig()
    step(twin, [[0.0] * 4] * 3)
    step(twin)
    np.testing.assert_array_equal(layer.mask(), twin_layer.mask())
    assert layer.mask()[7]


def test_a_layer_that_got_no_gradient_does_not_move():
    owner, layer, _ = rig()
    before = layer.mask()
    owner.optimizer.zero_grad()
    owner.optimizer.step()
    np.testing.assert_array_equal(layer.mask(), before)


def test_a_copy_trains_on_its_own_once_hooks_are_attached_and_the_original_stays():
    owner, layer, controller = rig()
    owner.controller = controller
    twin = copy.deepcopy(owner)
    assert not twin.controller.has_plans
    start(twin.controller, controller.networks[0].plan)
    twin.controller.attach()
    step(twin)
    assert np.flatnonzero(twin.controller.networks[0].layers[0].mask()).tolist() == [
        0, 1, 4, 7, 8, 9,
    ]  # fmt: skip
    assert np.flatnonzero(layer.mask()).tolist() == [0, 1, 4, 5, 8, 9]
    assert controller.networks[0].clock == 0
    assert not layer.weight.detach().flatten()[[2, 3, 6, 7, 10, 11]].any()


def test_attaching_twice_hooks_once():
    owner, _, controller = rig()
    controller.attach()
    controller.attach()
    step(owner)
    assert controller.networks[0].clock == 1


def test_a_new_optimizer_is_hooked_at_the_next_attach():
    owner, _, controller = rig()
    owner.optimizer = th.optim.SGD(owner.parameters(), lr=0.1)
    controller.attach()
    step(owner)
    assert controller.networks[0].clock == 1


def test_loaded_weights_are_masked_at_once_and_loaded_moments_before_the_next_step():
    owner, layer, controller = rig(optimizer=lambda p: th.optim.Adam(p, lr=0.1))
    controller.drop_plans()
    dense = nn.Sequential(nn.Linear(4, 3, bias=False))
    adam = th.optim.Adam(dense.parameters(), lr=0.1)
    dense[0].weight.sum().backward()
    adam.step()
    owner.load_state_dict(dense.state_dict(), strict=False)
    owner.optimizer.load_state_dict(adam.state_dict())
    inactive = ~layer.module.weight_mask
    assert not layer.weight[inactive].any()
    assert layer.weight[~inactive].all()
    step(owner)
    assert not layer.weight[inactive].any()
    assert not owner.optimizer.state[layer.weight]["exp_avg"][inactive].any()


def test_a_plan_of_a_training_that_is_over_is_dropped_at_the_next_one():
    owner, _, controller = rig()
    going_on = True
    start(controller, controller.networks[0].plan, lambda: going_on)
    controller.begin_training(owner)
    assert controller.has_plans
    going_on = False
    controller.begin_training(owner)
    assert not controller.has_plans


@pytest.mark.parametrize("sparse", [False, True])
def test_weight_decay_is_coupled_added_after_clipping_and_on_weights_only(sparse):
    owner = nn.Sequential(nn.Linear(4, 3))
    owner.optimizer = th.optim.SGD(owner.parameters(), lr=1.0)
    network = SparseNetwork("net", owner, [("0", owner[0])])
    controller = Controller([network], 1, functional_gradients=False, weight_decay=0.25)
    with th.no_grad():
        owner[0].weight.fill_(2.0)
        owner[0].bias.fill_(2.0)
    network.layers[0].set_mask(np.tile([True, False], 6))
    controller.attach()
    if sparse:
        controller.to_sparse(owner)
    (owner[0].weight.sum() + owner[0].bias.sum()).backward()
    # 6 active weights and 3 biases with gradient 1: norm 3, clipped to 1.5.
    nn.utils.clip_grad_norm_(owner.parameters(), 1.5)
    owner.optimizer.step()
    # weight: 2 - (0.5 + 0.25 * 2); bias: 2 - 0.5
    expected = np.tile([1.0, 0.0], 6)
    np.testing.assert_allclose(network.layers[0].dense(), expected, rtol=1e-5)
    np.testing.assert_allclose(owner[0].bias.detach(), 1.5, rtol=1e-5)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("twice", ["in one pass", "in one loss"])
def test_rigl_sees_the_sum_of_a_layers_gradients_where_it_is_used_twice(sparse, twice):
    """Each use alone would have grown another connection."""
    owner, layer, controller = rig(drop_fraction=1 / 6)  # one of six
    if sparse:
        controller.to_sparse(owner)
        layer = controller.networks[0].layers[0]
    # The gradient of weight (i, j) is g_i x_j: flat 7 gets 3 + 3, flat 11 gets 5, flat 2 gets 4.
    uses = [
        (th.tensor([[0.0, 0.0, 1.0, 1.0]]), th.tensor([[4.0, 3.0, 0.0]])),
        (th.tensor([[0.0, 0.0, 0.0, 1.0]]), th.tensor([[0.0, 3.0, 5.0]])),
    ]
    owner.optimizer.zero_grad()
    if twice == "in one loss":
        sum((owner(x) * g).sum() for x, g in uses).backward()
    else:
        x, g = (th.cat(parts) for parts in zip(*uses, strict=True))
        (owner(x) * g).sum().backward()
    owner.optimizer.step()
    # Dropped: flat 5 (0.1). Grown: flat 7, with 6.
    assert np.flatnonzero(layer.mask()).tolist() == [0, 1, 4, 7, 8, 9]
    # Its first step, with learning rate 1, is that very gradient.
    assert layer.dense()[7] == pytest.approx(-6.0)


class ByGradient(TopologyMethod):
    """Prunes where the gradient is least: a method with a gradient that never grows."""

    name = "gradient-prune-for-tests"
    needs_gradient = True

    def exchange(self, layer, update, *, dense_grad):
        score = np.where(layer.mask(), np.abs(dense_grad), np.inf)
        return Exchange(dropped=np.array([score.argmin()]), grown=np.empty(0, dtype=np.int64))


@pytest.mark.parametrize("functional", [False, True])
def test_a_method_may_prune_by_gradient_also_from_dense(functional):
    with registered(ByGradient):
        owner, layer, _ = rig(ByGradient.name, functional=functional)
        layer.set_mask(np.ones(12, dtype=bool))
        step(owner)  # the least gradient is 0.0, at 6
        assert np.flatnonzero(~layer.mask()).tolist() == [6]
        step(owner)  # then 0.5, at 5
        assert np.flatnonzero(~layer.mask()).tolist() == [5, 6]


class Greedy(TopologyMethod):
    """Drops what is not there."""

    name = "greedy-for-tests"
    options = frozenset()

    def exchange(self, layer, update, *, dense_grad):
        inactive = np.flatnonzero(~layer.mask())[:1]
        return Exchange(dropped=inactive, grown=np.empty(0, dtype=np.int64))


def test_an_impossible_exchange_of_a_third_party_is_rejected_by_name():
    with registered(Greedy):
        owner, layer, _ = rig(Greedy.name)
        with pytest.raises(TopologyError, match="exchange for 0 drops 1 and grows 0"):
            step(owner)
        assert layer.nnz == 6
