"""RigL on a 3x4 layer, index by index."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.topology import method_named


def exchanged(layer, update, grad):
    """(dropped, grown) as lists."""
    grad = np.array(grad, np.float32).ravel()
    exchange = method_named("rigl").exchange(layer, update, dense_grad=grad)
    layer.after(exchange)
    return exchange.dropped.tolist(), exchange.grown.tolist()


# Active 0, 2, 5, 7, 8, 11; half of them move: 2, 11 and 8 (|w| 0.1, 0.2, 0.3) are dropped.


def test_growth_goes_to_the_largest_gradients(three_by_four, make_update):
    grad = [[9, 1, 0, 3], [-5, 9, 4, 9], [0, -2, 0.5, 0]]
    assert exchanged(three_by_four, make_update(), grad) == ([2, 8, 11], [3, 4, 6])


def test_a_dropped_connection_is_regrown_if_its_gradient_is_largest(three_by_four, make_update):
    # Of the dropped ones 2 has the largest gradient of all, 8 and 11 have small ones; it is not
    # part of the exchange, for it keeps its value.
    grad = [[9, 0.1, -6, 0.3], [-2, 9, 1, 9], [0.2, 0.4, 0.5, 0]]
    assert exchanged(three_by_four, make_update(), grad) == ([8, 11], [4, 6])


def test_nothing_moves_if_all_dropped_connections_are_regrown(three_by_four, make_update):
    grad = [[0, 1, 5, 1], [1, 0, 1, 0], [-5, 1, 1, 5]]
    assert exchanged(three_by_four, make_update(), grad) == ([], [])


def test_gradients_of_connections_that_stay_do_not_matter(three_by_four, make_update):
    grad = np.array([[0, 1, 0, 3], [-5, 0, 4, 0], [0, -2, 0.5, 0]])
    expected = ([2, 8, 11], [3, 4, 6])
    assert exchanged(three_by_four, make_update(), grad) == expected
    grad.flat[[0, 5, 7]] = 1000
    assert exchanged(three_by_four, make_update(), grad) == expected


def test_equal_gradients_grow_at_the_lowest_index(three_by_four, make_update):
    # One 5; -1 and 1 tie at 3, 4, 6, 9: the two lowest.
    grad = [[0, 0.5, 0, -1], [1, 0, 1, 0], [0, -1, 5, 0]]
    assert exchanged(three_by_four, make_update(), grad) == ([2, 8, 11], [3, 4, 10])


def test_without_any_gradient_the_lowest_candidates_grow(three_by_four, make_update):
    # Candidates 1, 2, 3, 4, ...: 2 was just dropped and is regrown.
    assert exchanged(three_by_four, make_update(), np.zeros(12)) == ([8, 11], [1, 3])


def test_equal_weights_drop_at_the_lowest_index(make_layer, make_update):
    layer = make_layer([[0.5, 0, 0, -0.5], [0, 0.5, 0.9, 0], [0, 0, 0, 0]])
    grad = [[0, 0, 0, 0], [0, 0, 0, 0], [3, 2, 1, 0]]
    assert exchanged(layer, make_update(), grad) == ([0, 3], [8, 9])


def test_an_active_weight_of_zero_is_dropped_first(make_layer, make_update):
    layer = make_layer([[0.5, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0.1]], active=[0, 6, 11])
    # floor(0.5 * 3) = 1
    assert exchanged(layer, make_update(), [0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 0]) == ([6], [3])


def test_a_gradient_that_is_not_a_number_is_grown_last(three_by_four, make_update):
    nan = math.nan
    grad = [[0, nan, 0, nan], [0.1, 0, nan, 0], [0, 0.2, 0.3, 0]]
    assert exchanged(three_by_four, make_update(), grad) == ([2, 8, 11], [4, 9, 10])


# Of 6 active with drop fraction 0.5: floor(6 * 0.375) at cos 60 degrees, floor(6 * 0.25) at cos 90.
@pytest.mark.parametrize(
    ("progress", "expected"),
    [
        (0.0, ([2, 8, 11], [3, 4, 6])),
        (0.8 / 3, ([2, 11], [4, 6])),
        (0.4, ([2], [4])),
        (1.6 / 3, ([], [])),
    ],
)
def test_fewer_move_as_training_goes_on(three_by_four, make_update, progress, expected):
    grad = [[9, 1, 0, 3], [-5, 9, 4, 9], [0, -2, 0.5, 0]]
    assert exchanged(three_by_four, make_update(progress=progress), grad) == expected


def test_the_seed_and_the_step_do_not_matter(three_by_four, make_update):
    grad = [[9, 1, 0, 3], [-5, 9, 4, 9], [0, -2, 0.5, 0]]
    update = make_update(step=77, seed=5)
    assert exchanged(three_by_four, update, grad) == ([2, 8, 11], [3, 4, 6])


few_values = st.sampled_from([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0])


@st.composite
def layers(draw):
    size = draw(st.integers(2, 30))
    column = st.lists(few_values, min_size=size, max_size=size)
    active = draw(st.sets(st.integers(0, size - 1), min_size=1))
    return draw(column), draw(column), sorted(active)


@settings(max_examples=250, deadline=None)
@given(case=layers(), tenths=st.integers(0, 10))
def test_mask_is_that_of_a_brute_force_sort(make_layer, make_update, case, tenths):
    weights, grad, active = case
    layer = make_layer(weights, active=active)
    count = len(active) * tenths // 10
    dropped = sorted(active, key=lambda index: (abs(weights[index]), index))[:count]
    kept = set(active) - set(dropped)
    candidates = [index for index in range(len(weights)) if index not in kept]
    grown = sorted(candidates, key=lambda index: (-abs(grad[index]), index))[:count]
    exchange = method_named("rigl").exchange(
        layer, make_update(drop_fraction=tenths / 10), dense_grad=np.array(grad, np.float32)
    )
    assert layer.after(exchange).active == kept | set(grown)
