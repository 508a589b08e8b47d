"""Schedules at their ends, in between by hand, and monotone everywhere."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.sparsity.schedules import cosine_drop_fraction, pruned_count

ROUNDING = Fraction(1, 10**5)

quick = settings(max_examples=200, deadline=None)
fractions = st.floats(0, 1)


@st.composite
def ramps(draw):
    """(size, initial, final, begin, end): begin and end in per cent."""
    size = draw(st.integers(1, 5000))
    final = draw(st.integers(1, size))
    initial = draw(st.integers(final, size))
    begin = draw(st.integers(0, 99))
    end = draw(st.integers(begin + 1, 100))
    return size, initial, final, begin, end


@pytest.mark.parametrize(
    ("progress", "expected"),
    [
        (0.0, 0.4),
        (0.8 / 3, 0.3),  # cos 60 degrees = 1/2
        (0.4, 0.2),  # cos 90 degrees = 0
        (1.6 / 3, 0.1),  # cos 120 degrees = -1/2
    ],
)
def test_cosine_by_hand(progress, expected):
    assert cosine_drop_fraction(progress, 0.4, 0.8) == pytest.approx(expected, abs=1e-12)


def test_cosine_starts_at_exactly_the_drop_fraction():
    assert cosine_drop_fraction(0.0, 0.3, 0.8) == 0.3


@pytest.mark.parametrize("progress", [0.8, 0.80001, 0.9, 1.0, 1.2])
def test_cosine_is_exactly_zero_from_the_end_on(progress):
    assert cosine_drop_fraction(progress, 0.5, 0.8) == 0.0


@quick
@given(first=fractions, second=fractions, drop=fractions, end=st.floats(0.01, 1))
def test_cosine_never_rises(first, second, drop, end):
    early, late = sorted([first, second])
    assert cosine_drop_fraction(late, drop, end) <= cosine_drop_fraction(early, drop, end)


@quick
@given(progress=fractions, drop=fractions, end=st.floats(0.01, 1))
def test_cosine_stays_between_zero_and_the_drop_fraction(progress, drop, end):
    assert 0 <= cosine_drop_fraction(progress, drop, end) <= drop


@quick
@given(progress=fractions, end=st.floats(0.01, 1))
def test_cosine_of_a_zero_drop_fraction_is_zero(progress, end):
    assert cosine_drop_fraction(progress, 0.0, end) == 0.0


# 100 connections, from dense to 10, between 0.2 and 0.8. A quarter in: 90 * (1 - 27/64) = 52.03
# zeros; in the middle 90 * 7/8 = 78.75; three quarters in: 90 * 63/64 = 88.6.
@pytest.mark.parametrize(
    ("progress", "expected"),
    [
        (0.0, 100),
        (0.2, 100),
        (0.35, 100 - 52),
        (0.5, 100 - 78),
        (0.65, 100 - 88),
        (0.8, 10),
        (0.9, 10),
        (1.0, 10),
    ],
)
def test_pruning_from_dense_by_hand(progress, expected):
    assert pruned_count(100, 100, 10, progress, 0.2, 0.8) == expected


# 20 connections, 16 at first and 4 at last: in the middle 16 - 12/8 = 14.5 zeros.
@pytest.mark.parametrize(("progress", "expected"), [(0.2, 16), (0.5, 6), (0.8, 4)])
def test_pruning_from_a_sparse_start_by_hand(progress, expected):
    assert pruned_count(20, 16, 4, progress, 0.2, 0.8) == expected


def test_a_whole_number_of_zeros_is_not_lost_to_floating_error():
    # 16 connections to 8: in the middle 8 * 7/8 = 7 zeros, though 0.5 - 0.2 is not 0.3.
    assert pruned_count(16, 16, 8, 0.5, 0.2, 0.8) == 9
    # 1000 to 1, one tenth in: 999 * (1 - 0.729) = 270.7 zeros; 0.1 is no exact binary number.
    assert pruned_count(1000, 1000, 1, 0.1, 0.0, 1.0) == 730


@quick
@given(ramp=ramps(), per_mille=st.integers(0, 1000))
def test_pruning_agrees_with_rational_arithmetic(ramp, per_mille):
    size, initial, final, begin, end = ramp
    p = (Fraction(per_mille, 1000) - Fraction(begin, 100)) / Fraction(end - begin, 100)
    p = min(Fraction(1), max(Fraction(0), p))
    last = 1 - Fraction(final, size)
    first = 1 - Fraction(initial, size)
    zeros = (last + (first - last) * (1 - p) ** 3) * size
    count = pruned_count(size, initial, final, per_mille / 1000, begin / 100, end / 100)
    assert size - count in (math.floor(zeros), math.floor(zeros + ROUNDING))


@quick
@given(ramp=ramps(), after=fractions)
def test_pruning_ends_are_exact(ramp, after):
    size, initial, final, begin, end = ramp
    begin, end = begin / 100, end / 100
    assert pruned_count(size, initial, final, begin * after, begin, end) == initial
    assert pruned_count(size, initial, final, begin, begin, end) == initial
    assert pruned_count(size, initial, final, end, begin, end) == final
    assert pruned_count(size, initial, final, end + after, begin, end) == final


@quick
@given(ramp=ramps(), first=fractions, second=fractions)
def test_pruning_never_gives_back(ramp, first, second):
    size, initial, final, begin, end = ramp
    early, late = sorted([first, second])
    at_early = pruned_count(size, initial, final, early, begin / 100, end / 100)
    at_late = pruned_count(size, initial, final, late, begin / 100, end / 100)
    assert initial >= at_early >= at_late >= final
