"""GraNet by hand: what the ramp removes, and what is exchanged on the way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.topology import method_named

# By magnitude: 0, 1, ... 9; 10 to 15 are inactive.
WEIGHTS = [*(0.1 * (index + 1) * (-1) ** index for index in range(10)), *[0.0] * 6]
# The largest of 0 to 3 and 10 to 15: 12 and then 1.
GRADIENT = np.array([0, -8, 1, 2, 90, 91, 92, 93, 94, 95, 3, 4, -9, 5, 6, 7], np.float32)


@pytest.fixture
def at(make_update):
    """The mask update at a progress on the ramp from 0 to 0.8."""
    return lambda progress, f0=0.5, end=0.8: make_update(
        progress=progress, end=end, drop_fraction=f0
    )


def moved(layer, update, grad=GRADIENT):
    exchange = method_named("granet").exchange(layer, update, dense_grad=grad)
    after = layer.after(exchange)
    return exchange.dropped.tolist(), exchange.grown.tolist(), after


def test_ten_connections_become_eight_of_which_two_are_chosen_anew(make_layer, at):
    # In the middle of the ramp f = 0.5 / 2 = 0.25, and 1 - (1/2)^3 = 7/8 of the way is done: from
    # 22 of 24 to 6 leaves 22 - 14 = 8. So n = 2: the four least go, 0 to 3, of which 1 comes back.
    weights, grad = [*WEIGHTS, *[0.0] * 8], np.concatenate([GRADIENT, np.zeros(8, np.float32)])
    layer = make_layer(weights, initial_nnz=22, final_nnz=6)
    assert layer.nnz == 10
    dropped, grown, after = moved(layer, at(0.4), grad)
    assert dropped == [0, 2, 3]
    assert grown == [12]
    assert after.nnz == 8


def test_without_a_surplus_it_is_rigl(make_layer, at):
    # Final and initial counts are equal: K stays 10, f = 0.25, n = 2, and 0 and 1 go.
    layer = make_layer(WEIGHTS, initial_nnz=10, final_nnz=10)
    update = at(0.4)
    exchange = method_named("rigl").exchange(layer, update, dense_grad=GRADIENT)
    assert moved(layer, update)[:2] == (exchange.dropped.tolist(), exchange.grown.tolist())
    assert moved(layer, update)[:2] == ([0], [12])


def test_without_a_drop_fraction_it_is_pruning_along_the_same_ramp(make_layer, at):
    for progress in (0.0, 0.1, 0.3, 0.6, 0.8):
        layer = make_layer(WEIGHTS, initial_nnz=10, final_nnz=3)
        update = at(progress, f0=0.0)
        prune = method_named("prune").exchange(layer, update, dense_grad=None)
        assert moved(layer, update)[:2] == (prune.dropped.tolist(), [])


@pytest.mark.parametrize("progress", [0.8, 0.95, 1.0])
def test_at_the_end_the_count_is_exact_and_nothing_grows_with_a_gradient_or_without(
    make_layer, at, progress
):
    layer = make_layer(WEIGHTS, initial_nnz=10, final_nnz=3)
    for grad in (GRADIENT, None):
        dropped, grown, after = moved(layer, at(progress), grad)
        assert dropped == [0, 1, 2, 3, 4, 5, 6]
        assert grown == []
        assert moved(after, at(progress), grad)[:2] == ([], [])


def test_a_layer_that_the_distribution_leaves_dense_never_moves(make_layer, at):
    layer = make_layer(np.ones(16), initial_nnz=16, final_nnz=16)
    for progress in (0.0, 0.4, 1.0):
        assert moved(layer, at(progress, f0=1.0))[:2] == ([], [])


def test_a_dense_start_loses_the_surplus_and_regrows_among_what_it_dropped(make_layer, at):
    # K = 16 - floor(8 * 7/8) = 9, f = 0.25: n = 2, and 7 + 2 go, of which the gradient keeps two.
    layer = make_layer(np.arange(1, 17), initial_nnz=16, final_nnz=8)
    dropped, grown, after = moved(layer, at(0.4))
    assert grown == []
    assert after.nnz == 9
    assert set(range(9)) - set(dropped) == {7, 8}  # 93 and 94


def test_a_drop_fraction_of_one_exchanges_all_that_the_ramp_leaves(make_layer, at):
    layer = make_layer([0.5, 0.4, 0.3, 0.0], initial_nnz=3, final_nnz=3)
    dropped, grown, after = moved(layer, at(0.0, f0=1.0), np.array([1, 2, 3, 4], np.float32))
    assert (dropped, grown) == ([0], [3])
    assert after.nnz == 3


def test_training_on_at_a_lower_progress_brings_nothing_back(make_layer, at):
    layer = make_layer(WEIGHTS, active=[7, 8, 9], initial_nnz=10, final_nnz=3)
    for progress in (0.0, 0.2, 0.7):
        assert moved(layer, at(progress))[2].nnz == 3


@settings(max_examples=150, deadline=None)
@given(
    weights=st.lists(st.floats(-2, 2, width=32), min_size=1, max_size=40),
    data=st.data(),
    path=st.lists(st.floats(0, 1), max_size=6).map(sorted),
    f0=st.floats(0, 1),
    begin=st.sampled_from([0.0, 0.3]),
)
def test_the_count_follows_that_of_pruning_whatever_is_exchanged(
    make_layer, make_update, weights, data, path, f0, begin
):
    size = len(weights)
    initial = data.draw(st.integers(1, size))
    final = data.draw(st.integers(1, initial))
    grad = np.array(data.draw(st.lists(st.floats(-9, 9), min_size=size, max_size=size)))
    layer = pruned = make_layer(
        weights, active=range(initial), initial_nnz=initial, final_nnz=final
    )
    for progress in [*path, 1.0]:
        update = make_update(progress=progress, begin=begin, drop_fraction=f0)
        layer = layer.after(method_named("granet").exchange(layer, update, dense_grad=grad))
        pruned = pruned.after(method_named("prune").exchange(pruned, update, dense_grad=None))
        assert layer.nnz == pruned.nnz
    assert layer.nnz == final
