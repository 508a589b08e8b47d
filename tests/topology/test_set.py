"""SET on a 3x4 layer: how many move, which may, and that growth is uniform and repeatable."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sb3_sparse.topology import method_named

KEPT = {0, 5, 7}  # of 3x4, when the three of least magnitude (2, 8, 11) are dropped
CANDIDATES = {1, 3, 4, 6, 9, 10, 2, 8, 11}


def grown_of(layer, update):
    """The three candidates that SET makes active, regrown ones included."""
    exchange = method_named("set").exchange(layer, update, dense_grad=None)
    return layer.after(exchange).active - KEPT


@pytest.mark.parametrize("step", range(1, 40))
def test_the_largest_stay_and_as_many_are_grown_as_dropped(three_by_four, make_update, step):
    exchange = method_named("set").exchange(
        three_by_four, make_update(step=step, drop_fraction=0.5), dense_grad=None
    )
    after = three_by_four.after(exchange)
    assert after.active >= KEPT
    assert after.nnz == 6
    assert set(exchange.dropped.tolist()) <= {2, 8, 11}
    assert set(exchange.grown.tolist()) <= {1, 3, 4, 6, 9, 10}
    assert exchange.dropped.size == exchange.grown.size <= 3


# Of 6 active: 3; then floor(6 * 0.375) at cos 60 degrees, floor(6 * 0.25) at cos 90 degrees,
# floor(6 * 0.125) at cos 120 degrees.
@pytest.mark.parametrize(
    ("progress", "count"), [(0.0, 3), (0.8 / 3, 2), (0.4, 1), (1.6 / 3, 0), (0.79, 0)]
)
def test_the_most_that_ever_move_follow_the_cosine(three_by_four, make_update, progress, count):
    most = max(
        method_named("set")
        .exchange(three_by_four, make_update(progress=progress, step=step), dense_grad=None)
        .dropped.size
        for step in range(60)
    )
    assert most == count


def test_same_seed_layer_and_step_same_exchange(three_by_four, make_update):
    exchanges = [
        method_named("set").exchange(three_by_four, make_update(step=7), dense_grad=None)
        for _ in range(2)
    ]
    assert exchanges[0].dropped.tolist() == exchanges[1].dropped.tolist()
    assert exchanges[0].grown.tolist() == exchanges[1].grown.tolist()


def test_steps_seeds_and_layers_grow_independently(make_layer, make_update):
    weights = [1.0] * 50 + [0.0] * 450
    layer = make_layer(weights)
    critic = make_layer(weights, name="critic.qf0.0")
    places = [
        (layer, make_update(step=1)),
        (layer, make_update(step=2)),
        (layer, make_update(step=1, seed=1)),
        (critic, make_update(step=1)),
    ]
    grown = {
        tuple(method_named("set").exchange(where, update, dense_grad=None).grown.tolist())
        for where, update in places
    }
    assert len(grown) == len(places)


def test_the_global_generator_does_not_matter(three_by_four, make_update):
    np.random.seed(1)
    first = grown_of(three_by_four, make_update())
    state = np.random.get_state()
    np.random.seed(1)
    np.testing.assert_array_equal(state[1], np.random.get_state()[1])
    assert state[2] == np.random.get_state()[2]
    np.random.seed(2)
    assert first == grown_of(three_by_four, make_update())


def test_every_candidate_is_grown_equally_often_the_just_dropped_too(three_by_four, make_update):
    steps = 1500
    grown = [grown_of(three_by_four, make_update(step=step)) for step in range(steps)]
    assert set().union(*grown) == CANDIDATES
    # 3 of 9 each time: binomial with p = 1/3; five standard deviations.
    for candidate in CANDIDATES:
        count = sum(candidate in chosen for chosen in grown)
        assert abs(count - steps / 3) < 5 * math.sqrt(steps * 2 / 9)


def test_the_gradient_is_ignored(three_by_four, make_update):
    grad = np.zeros(12, np.float32)
    grad[10] = 100
    chosen = [
        method_named("set").exchange(three_by_four, make_update(), dense_grad=given)
        for given in (None, grad)
    ]
    assert chosen[0].grown.tolist() == chosen[1].grown.tolist()
