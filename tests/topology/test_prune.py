"""Gradual magnitude pruning by hand, from 12 connections to 3 between 0.2 and 0.8."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.topology import method_named

# By magnitude: 11, 1, 2, 3, 6, 7, 8, 0, 4, 5, 9, 10.
WEIGHTS = [[0.12, -0.02, 0.03, 0.04], [-0.5, 0.6, 0.07, -0.08], [0.09, 1.0, -1.1, 0.011]]


@pytest.fixture
def dense_layer(make_layer):
    return make_layer(WEIGHTS, initial_nnz=12, final_nnz=3)


@pytest.fixture
def at(make_update):
    """The mask update at a progress on the ramp from 0.2 to 0.8."""
    return lambda progress: make_update(progress=progress, begin=0.2, end=0.8, drop_fraction=0.0)


def pruned(layer, update):
    exchange = method_named("prune").exchange(layer, update, dense_grad=None)
    assert exchange.grown.size == 0
    layer.after(exchange)
    return exchange.dropped.tolist()


@pytest.mark.parametrize("progress", [0.0, 0.1, 0.2])
def test_nothing_is_pruned_up_to_the_beginning(dense_layer, at, progress):
    assert pruned(dense_layer, at(progress)) == []


# Zeros: 9 * (1 - (1 - p)^3). At a quarter 9 * 37/64 = 5.2, in the middle 9 * 7/8 = 7.9.
@pytest.mark.parametrize(
    ("progress", "expected"),
    [
        (0.35, [1, 2, 3, 6, 11]),
        (0.5, [1, 2, 3, 6, 7, 8, 11]),
        (0.8, [0, 1, 2, 3, 4, 6, 7, 8, 11]),
        (1.0, [0, 1, 2, 3, 4, 6, 7, 8, 11]),
    ],
)
def test_the_least_magnitudes_go_along_the_cubic_ramp(dense_layer, at, progress, expected):
    assert pruned(dense_layer, at(progress)) == expected


def test_only_the_surplus_goes_at_each_update(dense_layer, at):
    prune = method_named("prune")
    half = dense_layer.after(prune.exchange(dense_layer, at(0.5), dense_grad=None))
    assert half.nnz == 5
    assert pruned(half, at(0.5)) == []
    assert pruned(half, at(0.8)) == [0, 4]


def test_a_run_that_ends_late_is_brought_to_the_exact_count(make_layer, at):
    layer = make_layer(WEIGHTS, active=[0, 4, 5, 9, 10], initial_nnz=12, final_nnz=3)
    assert pruned(layer, at(1.0)) == [0, 4]


@pytest.mark.parametrize("progress", [0.0, 0.2, 0.5, 0.79])
def test_a_resumed_run_never_brings_anything_back(make_layer, at, progress):
    layer = make_layer(WEIGHTS, active=[5, 9, 10], initial_nnz=12, final_nnz=3)
    assert pruned(layer, at(progress)) == []


def test_a_sparse_start_is_taken_along_its_own_ramp(make_layer, at):
    # 9 of 12 at first, 3 at last: in the middle 9 - 6/8 = 8.25 zeros, 8, so that 4 stay.
    layer = make_layer(WEIGHTS, active=[0, 1, 2, 3, 4, 5, 6, 9, 10], initial_nnz=9, final_nnz=3)
    assert pruned(layer, at(0.2)) == []
    assert pruned(layer, at(0.5)) == [0, 1, 2, 3, 6]


def test_a_layer_that_is_left_dense_loses_nothing(make_layer, at):
    layer = make_layer(WEIGHTS, initial_nnz=12, final_nnz=12)
    assert pruned(layer, at(1.0)) == []


def test_equal_weights_go_at_the_lowest_index(make_layer, at):
    layer = make_layer([0.5, -0.5, 0.5, 0.5, 2.0, -0.5], initial_nnz=6, final_nnz=3)
    assert pruned(layer, at(0.8)) == [0, 1, 2]


def test_an_active_weight_of_zero_goes_before_any_other(make_layer, at):
    layer = make_layer([0.5, 0.0, 0.1, 0.3], active=[0, 2, 1, 3], initial_nnz=4, final_nnz=3)
    assert pruned(layer, at(0.8)) == [1]


def test_the_gradient_the_step_and_the_seed_do_not_matter(dense_layer, make_update):
    prune = method_named("prune")
    update = make_update(progress=0.5, begin=0.2, end=0.8, step=31, seed=9, drop_fraction=0.7)
    exchange = prune.exchange(dense_layer, update, dense_grad=np.arange(12.0))
    assert exchange.dropped.tolist() == [1, 2, 3, 6, 7, 8, 11]


@settings(max_examples=150, deadline=None)
@given(
    weights=st.lists(st.floats(-2, 2, width=32), min_size=1, max_size=40),
    data=st.data(),
    path=st.lists(st.floats(0, 1), max_size=6).map(sorted),
)
def test_the_mask_only_shrinks_and_ends_with_the_largest(
    make_layer, make_update, weights, data, path
):
    final = data.draw(st.integers(1, len(weights)))
    layer = make_layer(weights, active=range(len(weights)), final_nnz=final)
    for progress in [*path, 1.0]:
        update = make_update(progress=progress, begin=0.2, end=0.8)
        exchange = method_named("prune").exchange(layer, update, dense_grad=None)
        smaller = layer.after(exchange)
        assert smaller.active <= layer.active
        layer = smaller
    order = sorted(range(len(weights)), key=lambda index: (-abs(weights[index]), -index))
    assert layer.active == set(order[:final])
