"""What every method that drops and grows has in common."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.topology import DropGrow, method_named

METHODS = ["set", "rigl"]

quick = settings(max_examples=150, deadline=None)


class HighestIndex(DropGrow):
    """Grows the highest flat indices; keeps what it was asked."""

    name = "highest-index"

    def __init__(self):
        self.asked = []

    def scores(self, layer, update, candidates, *, dense_grad):
        self.asked.append((candidates.tolist(), dense_grad))
        return candidates


@st.composite
def cases(draw):
    """(weights, gradient, active indices) of a small layer."""
    size = draw(st.integers(1, 30))
    values = st.floats(-2, 2, width=32)
    weights = draw(st.lists(values, min_size=size, max_size=size))
    grad = draw(st.lists(values, min_size=size, max_size=size))
    active = draw(st.sets(st.integers(0, size - 1), min_size=1))
    return weights, np.array(grad, np.float32), active


@pytest.mark.parametrize("name", METHODS)
@quick
@given(
    case=cases(),
    per_cent=st.integers(0, 100),
    step=st.integers(1, 10**7),
    seed=st.integers(0, 2**32),
)
def test_nnz_never_changes_and_no_more_move_than_the_drop_fraction_allows(
    name, make_layer, make_update, case, per_cent, step, seed
):
    weights, grad, active = case
    layer = make_layer(weights, active=active)
    update = make_update(drop_fraction=per_cent / 100, step=step, seed=seed)
    exchange = method_named(name).exchange(layer, update, dense_grad=grad)
    assert layer.after(exchange).nnz == layer.nnz
    assert exchange.dropped.size == exchange.grown.size
    assert exchange.dropped.size <= len(active) * per_cent // 100


@pytest.mark.parametrize("name", METHODS)
@quick
@given(case=cases(), progress=st.floats(0, 0.79), step=st.integers(1, 1000))
def test_no_dropped_connection_outweighs_one_that_stays(
    name, make_layer, make_update, case, progress, step
):
    weights, grad, active = case
    layer = make_layer(weights, active=active)
    update = make_update(progress=progress, step=step)
    exchange = method_named(name).exchange(layer, update, dense_grad=grad)
    dropped = set(exchange.dropped.tolist())
    # Regrown ones stay too, whatever their weight: of the least ones, as many as could be dropped.
    ranked = sorted(active, key=lambda index: (abs(weights[index]), index))
    assert dropped <= set(ranked[: len(active) // 2])


@pytest.mark.parametrize("name", METHODS)
@quick
@given(case=cases(), progress=st.floats(0, 1), step=st.integers(1, 1000))
def test_a_drop_fraction_of_zero_moves_nothing(name, make_layer, make_update, case, progress, step):
    weights, grad, active = case
    layer = make_layer(weights, active=active)
    update = make_update(progress=progress, drop_fraction=0.0, step=step)
    assert not method_named(name).exchange(layer, update, dense_grad=grad)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("end", "progress"), [(0.8, 0.8), (0.8, 1.0), (0.5, 0.5), (0.75, 0.9)])
def test_nothing_moves_from_the_end_on(name, three_by_four, make_update, end, progress):
    grad = np.zeros(12, np.float32)
    grad[[1, 3, 4]] = 1
    method = method_named(name)
    late = make_update(progress=progress, end=end, drop_fraction=1.0)
    assert not method.exchange(three_by_four, late, dense_grad=grad)
    early = make_update(progress=0.0, end=end, drop_fraction=1.0)
    assert method.exchange(three_by_four, early, dense_grad=grad)


@pytest.mark.parametrize("name", METHODS)
def test_a_full_layer_stays_full(name, make_layer, make_update):
    layer = make_layer(np.ones((3, 4)))
    grad = np.arange(12, dtype=np.float32)
    assert not method_named(name).exchange(layer, make_update(drop_fraction=1.0), dense_grad=grad)


@pytest.mark.parametrize("name", METHODS)
def test_a_layer_too_small_for_one_connection_to_move_stays(name, make_layer, make_update):
    layer = make_layer([0.5, 0, 0, 0.2, 0, 0])  # floor(0.4 * 2) = 0
    grad = np.ones(6, np.float32)
    assert not method_named(name).exchange(layer, make_update(drop_fraction=0.4), dense_grad=grad)


@pytest.mark.parametrize("name", METHODS)
def test_indices_are_integers_that_can_index(name, three_by_four, make_update):
    exchange = method_named(name).exchange(
        three_by_four, make_update(), dense_grad=np.zeros(12, np.float32)
    )
    assert exchange.dropped.dtype == np.int64
    assert exchange.grown.dtype == np.int64


@pytest.mark.parametrize("name", METHODS)
def test_the_gradient_is_only_read(name, three_by_four, make_update):
    grad = np.arange(-6, 6, dtype=np.float32)
    grad.setflags(write=False)
    exchange = method_named(name).exchange(three_by_four, make_update(), dense_grad=grad)
    assert three_by_four.after(exchange).nnz == 6


@pytest.mark.parametrize(
    ("nnz", "drop_fraction", "count"), [(100, 0.29, 29), (100, 0.57, 57), (10, 0.3, 3), (9, 0.3, 2)]
)
def test_the_count_is_the_floor_of_the_decimal_product(
    make_layer, make_update, nnz, drop_fraction, count
):
    # 0.29 * 100 is 28.999999999999996 in floating point. The highest indices are all free.
    layer = make_layer([1.0] * nnz + [0.0] * nnz)
    update = make_update(drop_fraction=drop_fraction)
    exchange = HighestIndex().exchange(layer, update, dense_grad=None)
    assert exchange.dropped.tolist() == list(range(count))
    assert exchange.grown.tolist() == list(range(2 * nnz - count, 2 * nnz))


def test_candidates_are_the_inactive_and_the_just_dropped_in_order(three_by_four, make_update):
    method = HighestIndex()
    grad = np.ones(12, np.float32)
    exchange = method.exchange(three_by_four, make_update(), dense_grad=grad)
    [(candidates, given_grad)] = method.asked
    assert candidates == [1, 2, 3, 4, 6, 8, 9, 10, 11]
    assert given_grad is grad
    # 11, 10 and 9 are grown, of which 11 was just dropped.
    assert exchange.dropped.tolist() == [2, 8]
    assert exchange.grown.tolist() == [9, 10]


def test_a_drop_fraction_of_one_may_replace_every_connection(make_layer, make_update):
    layer = make_layer([[1.0, 2.0, 3.0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    exchange = HighestIndex().exchange(layer, make_update(drop_fraction=1.0), dense_grad=None)
    assert exchange.dropped.tolist() == [0, 1, 2]
    assert exchange.grown.tolist() == [9, 10, 11]
