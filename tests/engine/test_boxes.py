"""Actions within their bounds against the same by NumPy, bit for bit."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_sparse.engine.boxes import CLIP, SCALE, UNSCALE, Bounds

WAYS = {
    CLIP: lambda a, low, high: np.clip(a, low, high),
    UNSCALE: lambda a, low, high: low + (0.5 * (a + 1.0) * (high - low)),
    SCALE: lambda a, low, high: (2.0 * ((a - low) / (high - low))) - 1.0,
}
NUMBERS = st.floats(-1e6, 1e6, width=32)


@pytest.mark.parametrize("how", WAYS)
@given(
    actions=st.lists(NUMBERS, min_size=6, max_size=6),
    lows=st.lists(NUMBERS, min_size=3, max_size=3),
    widths=st.lists(st.floats(2**-10, 1e6, width=32), min_size=3, max_size=3),
)
def test_they_are_those_of_numpy_to_the_bit(how, actions, lows, widths):
    low = np.array(lows, np.float32)
    high = low + np.array(widths, np.float32) + np.float32(1.0)
    given = np.array(actions, np.float32).reshape(2, 3)
    bounds = Bounds(low, high)
    for part in (given, given[0], given[:, ::-1], np.asfortranarray(given)):
        before = part.copy()
        found = bounds.of(part, how)
        np.testing.assert_array_equal(found, WAYS[how](part, low, high))
        np.testing.assert_array_equal(part, before)
        assert found.dtype == np.float32
        assert found.flags.writeable


def test_what_is_not_finite_stays_so():
    bounds = Bounds(np.float32([-1, -1, -1]), np.float32([1, 1, 1]))
    given = np.float32([np.nan, np.inf, -np.inf])
    np.testing.assert_array_equal(bounds.of(given, CLIP), [np.nan, 1, -1])
    np.testing.assert_array_equal(bounds.of(given, UNSCALE), given)


@pytest.mark.parametrize(
    "actions",
    [
        np.zeros((2, 3)),
        np.zeros((2, 2), np.float32),
        np.zeros(6, np.float32),
        np.zeros((2, 3), int),
    ],
)
def test_others_are_left_to_numpy(actions):
    assert Bounds(np.zeros(3, np.float32), np.ones(3, np.float32)).of(actions, CLIP) is None


def test_bounds_that_cannot_be_read():
    low, high = np.zeros(3, np.float32), np.ones(3, np.float32)
    assert Bounds.readable(low, high)
    assert not Bounds.readable(low.astype(np.float64), high)
    assert not Bounds.readable(low, np.ones(6, np.float32)[::2])
    assert not Bounds.readable(low, np.ones(2, np.float32))


def test_copies_and_pickles_begin_anew():
    bounds = Bounds(np.zeros(3, np.float32), np.ones(3, np.float32))
    assert copy.deepcopy(bounds) is None
    assert pickle.loads(pickle.dumps(bounds)) is None
