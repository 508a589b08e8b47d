"""Random masks and the weights of a sparse start."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.sparsity.initialisation import (
    glorot_limits,
    random_mask,
    sparsity_aware_weights,
)

quick = settings(max_examples=100, deadline=None)
SEEDS = 1500


@st.composite
def masks_to_draw(draw):
    shape = draw(st.lists(st.integers(1, 7), min_size=2, max_size=4))
    return tuple(shape), draw(st.integers(1, math.prod(shape)))


@quick
@given(case=masks_to_draw(), seed=st.integers(0, 2**32), name=st.text(max_size=10))
def test_a_mask_has_exactly_the_count(case, seed, name):
    shape, active = case
    mask = random_mask(shape, active, seed, name)
    assert mask.shape == shape
    assert mask.dtype == np.bool_
    assert int(mask.sum()) == active


def test_same_seed_and_name_same_mask():
    first = random_mask((30, 20), 60, 4, "actor.mu")
    np.testing.assert_array_equal(first, random_mask((30, 20), 60, 4, "actor.mu"))


def test_seeds_layers_and_critics_have_masks_of_their_own():
    places = [(0, "critic.qf0.0"), (0, "critic.qf1.0"), (0, "critic.qf0.2"), (1, "critic.qf0.0")]
    masks = {random_mask((30, 20), 60, seed, name).tobytes() for seed, name in places}
    assert len(masks) == len(places)


def test_masks_and_weights_leave_the_global_generators_alone():
    np.random.seed(1)
    th.manual_seed(1)
    numpy_before, torch_before = np.random.get_state(), th.get_rng_state()
    mask = random_mask((30, 20), 60, 0, "layer")
    sparsity_aware_weights(mask, 0, "layer")
    np.testing.assert_array_equal(numpy_before[1], np.random.get_state()[1])
    assert numpy_before[2] == np.random.get_state()[2]
    assert th.equal(torch_before, th.get_rng_state())


@pytest.fixture(scope="module")
def many_masks():
    """Masks of 5 of 12 connections over many seeds, shape (seeds, 12)."""
    return np.array([random_mask((3, 4), 5, seed, "layer").ravel() for seed in range(SEEDS)])


def test_each_connection_is_active_equally_often(many_masks):
    p = 5 / 12
    excess = many_masks.sum(axis=0) - SEEDS * p
    statistic = (excess**2).sum() / (SEEDS * p * (1 - p)) * 11 / 12
    # Chi-square with 11 degrees of freedom: 40 is passed in 4 of 100,000 uniform draws.
    assert statistic < 40
    # and one that fits too well is not random either: below 1.5 in 3 of 10,000.
    assert statistic > 1.5


def test_each_pair_of_connections_is_active_equally_often(many_masks):
    together = many_masks.T.astype(int) @ many_masks.astype(int)
    p = 5 * 4 / (12 * 11)
    pairs = together[np.triu_indices(12, k=1)]
    deviation = math.sqrt(SEEDS * p * (1 - p))
    assert np.abs(pairs - SEEDS * p).max() < 5 * deviation


def test_masks_of_two_layers_are_independent(many_masks):
    other = np.array([random_mask((3, 4), 5, seed, "other").ravel() for seed in range(SEEDS)])
    together = (many_masks & other).sum(axis=0)
    p = (5 / 12) ** 2
    assert np.abs(together - SEEDS * p).max() < 5 * math.sqrt(SEEDS * p * (1 - p))


def test_glorot_limits_of_a_small_mask_by_hand():
    mask = np.array([[1, 1, 0], [0, 1, 0]], dtype=np.bool_)  # fan-in 2, 1; fan-out 1, 2, 0
    limits = glorot_limits(mask)
    assert limits.shape == (2, 3)
    assert limits[0, 0] == pytest.approx(math.sqrt(3 / 1.5))
    assert limits[0, 1] == pytest.approx(math.sqrt(3 / 2))
    assert limits[1, 1] == pytest.approx(math.sqrt(3 / 1.5))


def test_glorot_limit_is_never_above_the_square_root_of_three():
    mask = np.array([[1, 0], [0, 0]], dtype=np.bool_)
    limits = glorot_limits(mask)
    assert limits[0, 0] == pytest.approx(math.sqrt(3))
    assert limits.max() <= math.sqrt(3)


def test_glorot_limits_of_a_convolution_sum_over_the_window():
    mask = np.zeros((2, 2, 2, 2), dtype=np.bool_)
    mask[0, 0] = [[1, 0], [0, 1]]
    mask[0, 1] = [[0, 0], [1, 0]]
    mask[1, 1] = True
    # fan-in of the outputs: 2 + 1 and 4; fan-out of the inputs: 2 and 1 + 4.
    limits = glorot_limits(mask)
    assert limits.shape == (2, 2, 1, 1)
    expected = [[math.sqrt(3 / 2.5), math.sqrt(3 / 4)], [math.sqrt(3 / 3), math.sqrt(3 / 4.5)]]
    np.testing.assert_allclose(limits[:, :, 0, 0], expected, rtol=1e-12)


@pytest.mark.parametrize("gain", [0.01, 1.0, math.sqrt(2)])
def test_gain_multiplies_the_limits(gain):
    mask = np.array([[1, 1, 0], [0, 1, 0]], dtype=np.bool_)
    assert glorot_limits(mask, gain)[0, 1] == pytest.approx(gain * math.sqrt(1.5))


@pytest.mark.parametrize("shape", [(12, 256), (32, 4, 8, 8)])
def test_a_dense_mask_has_the_bound_of_glorot(shape):
    window = math.prod(shape[2:])
    bound = math.sqrt(6 / ((shape[0] + shape[1]) * window))
    np.testing.assert_allclose(glorot_limits(np.ones(shape, dtype=np.bool_)), bound, rtol=1e-12)


@st.composite
def masks(draw):
    shape = draw(st.sampled_from([(3, 4), (5, 2), (1, 6), (2, 3, 2, 2)]))
    cells = math.prod(shape)
    drawn = draw(st.lists(st.booleans(), min_size=cells, max_size=cells))
    return np.array(drawn, dtype=np.bool_).reshape(shape)


@quick
@given(mask=masks(), seed=st.integers(0, 1000), gain=st.sampled_from([0.01, 1.0, 2.0]))
def test_weights_are_zero_where_inactive_and_within_their_limit_elsewhere(mask, seed, gain):
    weights = sparsity_aware_weights(mask, seed, "layer", gain)
    assert weights.dtype == np.float32
    assert weights.shape == mask.shape
    for place in np.ndindex(mask.shape):
        output, source = place[:2]
        mean_fan = (int(mask[output].sum()) + int(mask[:, source].sum())) / 2
        limit = gain * math.sqrt(3 / max(1.0, mean_fan))
        if mask[place]:
            assert 0 < abs(weights[place]) <= limit * (1 + 1e-6)
        else:
            assert weights[place] == 0


def test_weights_are_uniform_up_to_the_limit():
    weights = sparsity_aware_weights(np.ones((200, 100), dtype=np.bool_), 0, "layer")
    limit = math.sqrt(6 / 300)
    tenths = np.histogram(weights, bins=10, range=(-limit, limit))[0]
    assert tenths.sum() == 20_000
    # Binomial with mean 2000 and standard deviation 42: five of them.
    assert np.abs(tenths - 2000).max() < 212


def test_weights_scale_with_the_gain():
    mask = random_mask((10, 8), 30, 0, "layer")
    once = sparsity_aware_weights(mask, 0, "layer")
    np.testing.assert_array_equal(sparsity_aware_weights(mask, 0, "layer", gain=2.0), 2 * once)


def test_weights_depend_on_seed_and_name_only():
    mask = np.ones((10, 8), dtype=np.bool_)
    first = sparsity_aware_weights(mask, 0, "critic.qf0.0")
    np.testing.assert_array_equal(first, sparsity_aware_weights(mask, 0, "critic.qf0.0"))
    assert not np.array_equal(first, sparsity_aware_weights(mask, 0, "critic.qf1.0"))
    assert not np.array_equal(first, sparsity_aware_weights(mask, 1, "critic.qf0.0"))
