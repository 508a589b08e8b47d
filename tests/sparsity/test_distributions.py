"""How many connections each layer gets, against exact rational arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.distributions import (
    DISTRIBUTIONS,
    active_counts,
    check_distribution,
    check_sparsity,
    floor_count,
)

ROUNDING = Fraction(1, 10**5)  # more than floating error, less than any count

linear = st.tuples(st.integers(1, 80), st.integers(1, 80))
conv = st.tuples(st.integers(1, 24), st.integers(1, 24), st.integers(1, 5), st.integers(1, 5))
networks = st.lists(linear | conv, min_size=1, max_size=6)
permille = st.integers(0, 999)

quick = settings(max_examples=150, deadline=None)


def kept_by_floor(size: int, k: int) -> int:
    """N - floor(k/1000 * N) in integers."""
    return size - (k * size) // 1000


def exact_erdos_renyi(shapes, k, dims_of):
    """Ideal (unrounded) number of connections of each layer at sparsity k/1000."""
    sizes = [math.prod(shape) for shape in shapes]
    dims = [dims_of(shape) for shape in shapes]
    scores = [Fraction(sum(d), math.prod(d)) for d in dims]
    total = sum(kept_by_floor(size, k) for size in sizes)
    dense = set()
    while True:
        free = [i for i in range(len(shapes)) if i not in dense]
        if not free:
            return [Fraction(size) for size in sizes]
        left = total - sum(sizes[i] for i in dense)
        epsilon = Fraction(left) / sum(scores[i] * sizes[i] for i in free)
        top = max(scores[i] for i in free)
        if epsilon * top <= 1:
            return [
                Fraction(size) if i in dense else epsilon * scores[i] * size
                for i, size in enumerate(sizes)
            ]
        dense |= {i for i in free if scores[i] == top}


def test_erk_of_dqn_classic_control():
    assert active_counts([(512, 4), (512, 512), (2, 512)], 0.9, "erk") == [2048, 23451, 1024]


@pytest.mark.parametrize(
    ("sparsity", "expected"), [(0.8, [4008, 7515, 3072]), (0.9, [1893, 3549, 1858])]
)
def test_erk_of_halfcheetah_actor(sparsity, expected):
    assert active_counts([(256, 17), (256, 256), (12, 256)], sparsity, "erk") == expected


def test_erk_of_halfcheetah_critic():
    assert active_counts([(256, 23), (256, 256), (1, 256)], 0.9, "erk") == [2439, 4475, 256]


def test_erk_of_atari_cnn():
    shapes = [(32, 4, 8, 8), (64, 32, 4, 4), (64, 64, 3, 3), (512, 7744), (6, 512)]
    assert active_counts(shapes, 0.9, "erk") == [2444, 4887, 6296, 387889, 3072]


def test_erk_is_the_default():
    shapes = [(256, 17), (256, 256), (12, 256)]
    assert active_counts(shapes, 0.9) == [1893, 3549, 1858]


# Conv 4 -> 8 with a 3x3 window (288 weights) and Linear 40 -> 10 (400) at 0.5: 344 remain.
# er:  score * size = (8 + 4) * 9 = 108 and 50; 344 * 108 / 158 = 235.1, 344 * 50 / 158 = 108.9.
# erk: score * size = 8 + 4 + 3 + 3 = 18 and 50; 344 * 18 / 68 = 91.1, 344 * 50 / 68 = 252.9.
@pytest.mark.parametrize(("distribution", "expected"), [("er", [236, 109]), ("erk", [92, 253])])
def test_window_counts_for_erk_and_not_for_er(distribution, expected):
    assert active_counts([(8, 4, 3, 3), (10, 40)], 0.5, distribution) == expected


def test_layers_that_tie_for_the_largest_score_become_dense_together():
    # Both 2x2 layers score 1, 20x20 scores 1/10: at 0.8 there remain 2 * (4 - 3) + 80 = 82, epsilon
    # = 82 / (4 + 4 + 40) > 1, so both 2x2 are dense and 82 - 8 = 74 are left for the large one.
    assert active_counts([(2, 2), (20, 20), (2, 2)], 0.8, "erk") == [4, 74, 4]


def test_a_second_layer_becomes_dense_after_the_first_one_did():
    # Scores 3/2, 7/12, 1/10 with score * size = 3, 7, 40; at 0.7 there remain 1 + 4 + 120 = 125.
    # epsilon = 125/50 = 2.5: 2x1 dense. Then 123/47 = 2.6, times 7/12 is 1.5: 4x3 dense too.
    # 111 are left for the last.
    assert active_counts([(2, 1), (4, 3), (20, 20)], 0.7, "erk") == [2, 12, 111]


@pytest.mark.parametrize(
    ("sparsity", "shape", "zeros"),
    [(0.9, (10, 10), 90), (0.29, (10, 10), 29), (0.57, (10, 10), 57), (0.9, (3, 3), 8)],
)
def test_uniform_zeros_are_the_floor_of_the_decimal_product(sparsity, shape, zeros):
    assert active_counts([shape], sparsity, "uniform") == [math.prod(shape) - zeros]


@quick
@given(
    shapes=st.lists(st.tuples(st.integers(1, 8000), st.integers(1, 600)), min_size=1, max_size=4),
    k=permille,
)
def test_uniform_is_exact_in_every_layer(shapes, k):
    expected = [kept_by_floor(a * b, k) for a, b in shapes]
    assert active_counts(shapes, k / 1000, "uniform") == expected


@quick
@given(shapes=networks, k=st.integers(0, 99))
def test_uniform_is_exact_for_per_cent(shapes, k):
    expected = [kept_by_floor(math.prod(shape), 10 * k) for shape in shapes]
    assert active_counts(shapes, k / 100, "uniform") == expected


@quick
@given(shapes=networks, k=permille, distribution=st.sampled_from(["uniform", "er", "erk"]))
def test_every_layer_has_between_one_and_all_of_its_connections(shapes, k, distribution):
    counts = active_counts(shapes, k / 1000, distribution)
    assert len(counts) == len(shapes)
    for count, shape in zip(counts, shapes, strict=True):
        assert type(count) is int
        assert 1 <= count <= math.prod(shape)


@quick
@given(shapes=networks, k=permille)
def test_uniform_total_is_within_one_connection_a_layer(shapes, k):
    total = sum(active_counts(shapes, k / 1000, "uniform"))
    ideal = Fraction(1000 - k, 1000) * sum(math.prod(shape) for shape in shapes)
    assert 0 <= total - ideal < len(shapes)


@quick
@given(shapes=networks, k=permille, distribution=st.sampled_from(["er", "erk"]))
def test_erdos_renyi_total_is_within_one_connection_a_layer(shapes, k, distribution):
    total = sum(active_counts(shapes, k / 1000, distribution))
    budget = sum(kept_by_floor(math.prod(shape), k) for shape in shapes)
    assert 0 <= total - budget < len(shapes)


@quick
@given(shapes=networks, k=permille)
@pytest.mark.parametrize(
    ("distribution", "dims_of"),
    [("er", lambda shape: shape[:2]), ("erk", lambda shape: shape)],
)
def test_erdos_renyi_agrees_with_rational_arithmetic(distribution, dims_of, shapes, k):
    counts = active_counts(shapes, k / 1000, distribution)
    for count, ideal in zip(counts, exact_erdos_renyi(shapes, k, dims_of), strict=True):
        assert count in (math.ceil(ideal), math.ceil(ideal - ROUNDING))


@quick
@given(shapes=networks, k=permille)
def test_erk_densities_are_proportional_to_the_scores_where_not_dense(shapes, k):
    # One epsilon must explain all layers: count - 1 < epsilon * score * N <= count, where
    # score * N is the sum of the dimensions; a dense layer bounds it only from below.
    counts = active_counts(shapes, k / 1000, "erk")
    least = max(Fraction(count - 1, sum(dims)) for count, dims in zip(counts, shapes, strict=True))
    most = [
        (count + ROUNDING) / sum(dims)
        for count, dims in zip(counts, shapes, strict=True)
        if count < math.prod(dims)
    ]
    assert all(least <= bound for bound in most)


@quick
@given(shapes=st.lists(linear, min_size=1, max_size=6), k=permille)
def test_er_and_erk_agree_where_there_is_no_window(shapes, k):
    assert active_counts(shapes, k / 1000, "er") == active_counts(shapes, k / 1000, "erk")


@quick
@given(shapes=networks, distribution=st.sampled_from(["uniform", "er", "erk"]))
def test_sparsity_zero_leaves_every_layer_dense(shapes, distribution):
    assert active_counts(shapes, 0.0, distribution) == [math.prod(shape) for shape in shapes]


@pytest.mark.parametrize("distribution", ["uniform", "er", "erk"])
def test_a_layer_keeps_one_connection_however_sparse(distribution):
    assert active_counts([(4, 3), (3, 4)], math.nextafter(1.0, 0.0), distribution) == [1, 1]


def test_shapes_may_be_lists():
    assert active_counts([[10, 10]], 0.9, "uniform") == [10]


@pytest.mark.parametrize(
    "value", [-0.1, 1, 1.0, 1.5, math.inf, -math.inf, math.nan, True, False, "0.9", None, [0.9]]
)
def test_sparsity_outside_of_its_range_is_an_error_that_names_the_range(value):
    with pytest.raises(ConfigError, match=r"sparsity .*\[0, 1\)"):
        active_counts([(4, 4)], value)


def test_error_names_the_argument_and_the_value():
    with pytest.raises(ConfigError, match=r"initial_sparsity must .* got 1\.25"):
        check_sparsity(1.25, "initial_sparsity")


def test_a_percentage_is_told_its_fraction():
    with pytest.raises(ConfigError, match=r"got 90; 90 % is 0\.9$"):
        check_sparsity(90)
    with pytest.raises(ConfigError, match=r"got 99\.5; 99\.5 % is 0\.995$"):
        check_sparsity(99.5)


@pytest.mark.parametrize(("value", "expected"), [(0, 0.0), (0.0, 0.0), (0.9, 0.9), (0.999, 0.999)])
def test_sparsity_within_its_range_is_returned_as_a_float(value, expected):
    checked = check_sparsity(value)
    assert type(checked) is float
    assert checked == expected


@pytest.mark.parametrize("name", ["magic", "ERK", "", None, 3])
def test_unknown_distribution_is_an_error_that_lists_the_allowed(name):
    with pytest.raises(ConfigError, match="er, erk, uniform") as caught:
        active_counts([(4, 4)], 0.5, name)
    assert repr(name) in str(caught.value)


def test_distribution_given_as_a_list_is_an_error_of_this_package():
    with pytest.raises(ConfigError, match="er, erk, uniform"):
        check_distribution(["erk"])


def test_known_distributions_pass_the_check():
    assert [check_distribution(name) for name in ("er", "erk", "uniform")] == sorted(DISTRIBUTIONS)


@pytest.mark.parametrize("shape", [(), (5,), (0, 3), (3, 0), (4, -2), (4, 4, 0, 3)])
def test_a_shape_that_is_no_weight_is_an_error_that_shows_it(shape):
    with pytest.raises(ConfigError, match="two or more positive dimensions") as caught:
        active_counts([(4, 4), shape], 0.5)
    assert repr(shape) in str(caught.value)


@quick
@given(k=permille, size=st.integers(1, 10**7))
def test_floor_count_of_a_decimal_product_is_the_integer_floor(k, size):
    assert floor_count(k / 1000 * size) == (k * size) // 1000
