"""Selection against a brute-force sort."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.sparsity.selection import largest, least_magnitude

quick = settings(max_examples=250, deadline=None)

FEW = [-2.0, -1.0, -0.0, 0.0, 0.5, 1.0, math.nan]
some_floats = st.sampled_from(FEW) | st.floats(
    width=32, allow_nan=True, allow_infinity=False, min_value=None
)


def sorted_out(scores, count):
    """Sort by falling score and rising index, NaN last, and take the first ``count``."""

    def rank(index):
        score = scores[index]
        return (score != score, 0 if score != score else -score, index)

    return sorted(sorted(range(len(scores)), key=rank)[:count])


@st.composite
def scored(draw, elements):
    scores = draw(st.lists(elements, min_size=1, max_size=30))
    return scores, draw(st.integers(0, len(scores)))


@quick
@given(case=scored(some_floats), dtype=st.sampled_from([np.float32, np.float64]))
def test_floats_are_chosen_as_by_sorting(case, dtype):
    scores, count = case
    assert largest(np.array(scores, dtype), count).tolist() == sorted_out(scores, count)


@quick
@given(case=scored(st.integers(0, 3) | st.integers(0, 2**64 - 1)))
def test_unsigned_integers_are_chosen_as_by_sorting(case):
    scores, count = case
    assert largest(np.array(scores, np.uint64), count).tolist() == sorted_out(scores, count)


@quick
@given(case=scored(st.integers(-3, 3) | st.integers(-(2**63) + 1, 2**63 - 1)))
def test_signed_integers_are_chosen_as_by_sorting(case):
    scores, count = case
    assert largest(np.array(scores, np.int64), count).tolist() == sorted_out(scores, count)


def test_by_hand():
    scores = np.array([0.3, 0.9, 0.1, 0.9, 0.5])
    assert largest(scores, 1).tolist() == [1]
    assert largest(scores, 2).tolist() == [1, 3]
    assert largest(scores, 3).tolist() == [1, 3, 4]


def test_ties_go_to_the_lowest_index():
    assert largest(np.array([1.0, 2.0, 1.0, 2.0, 1.0, 1.0]), 4).tolist() == [0, 1, 2, 3]
    assert largest(np.full(1000, 0.25), 7).tolist() == list(range(7))


def test_positive_and_negative_zero_tie():
    assert largest(np.array([-0.0, 0.0, -0.0]), 2).tolist() == [0, 1]


def test_nan_counts_as_the_smallest():
    scores = np.array([math.nan, -1e30, math.nan, 5.0])
    assert largest(scores, 2).tolist() == [1, 3]
    assert largest(scores, 3).tolist() == [0, 1, 3]


def test_infinity_is_a_score_like_any_other():
    assert largest(np.array([1.0, math.inf, -math.inf, 2.0]), 3).tolist() == [0, 1, 3]


def test_neighbouring_integers_beyond_the_precision_of_floats_are_told_apart():
    scores = np.array([2**64 - 2, 2**64 - 1, 2**64 - 3], np.uint64)
    assert largest(scores, 1).tolist() == [1]


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_result_is_of_integers_that_can_index(count):
    chosen = largest(np.array([3.0, 1.0, 2.0]), count)
    assert chosen.dtype == np.int64
    assert chosen.shape == (count,)


def test_scores_are_left_as_they_were():
    scores = np.array([math.nan, 3.0, 1.0, 2.0])
    before = scores.copy()
    largest(scores, 2)
    np.testing.assert_array_equal(scores, before)


@st.composite
def weighted(draw):
    weights = draw(
        st.lists(
            st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0]) | st.floats(-3, 3, width=32),
            min_size=1,
            max_size=30,
        )
    )
    active = sorted(draw(st.sets(st.integers(0, len(weights) - 1))))
    return weights, active, draw(st.integers(0, len(active)))


@quick
@given(case=weighted())
def test_least_magnitude_is_as_by_sorting(case):
    weights, active, count = case
    expected = sorted(sorted(active, key=lambda index: (abs(weights[index]), index))[:count])
    chosen = least_magnitude(np.array(weights, np.float32), np.array(active, np.int64), count)
    assert chosen.tolist() == expected


def test_least_magnitude_by_hand():
    weights = np.array([0.5, 0.0, -0.1, 0.0, 0.2, -0.1], np.float32)
    active = np.array([0, 2, 4, 5])
    assert least_magnitude(weights, active, 1).tolist() == [2]
    assert least_magnitude(weights, active, 2).tolist() == [2, 5]
    assert least_magnitude(weights, active, 3).tolist() == [2, 4, 5]


def test_an_active_connection_of_weight_zero_goes_first():
    weights = np.array([0.1, 0.0, 0.0, 0.3], np.float32)
    assert least_magnitude(weights, np.array([0, 2, 3]), 1).tolist() == [2]
