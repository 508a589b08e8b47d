"""Widths of the parameter-equivalent dense network, against all factors there are."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.widths import equivalent_widths, mlp_parameters, scaled_widths


def parameters_of(inputs, outputs):
    """Count of a multi-layer perceptron, written out."""

    def count(hidden):
        sizes = [inputs, *hidden, outputs]
        return sum((sizes[i] + 1) * sizes[i + 1] for i in range(len(sizes) - 1))

    return count


def all_scaled(hidden):
    """Every list of widths that some factor in [0, 1] gives."""
    edges = {0.0, 1.0, *((k + 0.5) / n for n in hidden for k in range(n))}
    found = {}
    for edge in edges:
        below = above = edge
        for _ in range(3):  # a few floats around, for the rounding of width * factor
            for factor in (below, above):
                widths = tuple(max(1, round(n * factor)) for n in hidden)
                found[widths] = None
            below, above = max(0.0, math.nextafter(below, -1)), min(1.0, math.nextafter(above, 2))
    return list(found)


def test_parameters_by_hand():
    # 3 -> 4 -> 5 -> 2: (3 + 1) * 4 + (4 + 1) * 5 + (5 + 1) * 2
    assert mlp_parameters(3, [4, 5], 2) == 16 + 25 + 12


def test_parameters_without_a_hidden_layer():
    assert mlp_parameters(3, [], 2) == 8


def test_parameters_of_the_halfcheetah_critic():
    assert mlp_parameters(23, [256, 256], 1) == 71680 + 256 + 256 + 1


@pytest.mark.parametrize(
    ("factor", "expected"), [(0.3, [19, 10]), (1.0, [64, 32]), (0.5, [32, 16]), (0.001, [1, 1])]
)
def test_widths_are_rounded_and_at_least_one(factor, expected):
    assert scaled_widths([64, 32], factor) == expected


# One hidden layer of width n between 1 input and 2 outputs: 4 n + 2 parameters, 6, 10, 14, 18.
@pytest.mark.parametrize(
    ("target", "width", "count"),
    [(18, 4, 18), (17, 4, 18), (15, 3, 14), (14, 3, 14), (13, 3, 14), (11, 2, 10), (7, 1, 6)],
)
def test_nearest_width_by_hand(target, width, count):
    assert equivalent_widths([4], parameters_of(1, 2), target) == ([width], count)


@pytest.mark.parametrize(("target", "width", "count"), [(16, 3, 14), (12, 2, 10), (8, 1, 6)])
def test_a_tie_goes_to_the_smaller_network(target, width, count):
    assert equivalent_widths([4], parameters_of(1, 2), target) == ([width], count)


def test_a_target_below_the_smallest_network_gives_widths_of_one():
    assert equivalent_widths([4, 6], parameters_of(1, 2), 1) == ([1, 1], 2 + 2 + 4)


def test_the_full_target_gives_the_full_network():
    assert equivalent_widths([4, 6], parameters_of(1, 2), 8 + 30 + 14) == ([4, 6], 52)


def test_a_target_above_the_full_network_is_an_error_that_names_both_counts():
    with pytest.raises(ConfigError, match=r"target of 53 .* 52 .*\[4, 6\]"):
        equivalent_widths([4, 6], parameters_of(1, 2), 53)


@settings(max_examples=150, deadline=None)
@given(
    hidden=st.lists(st.integers(1, 20), min_size=1, max_size=3),
    inputs=st.integers(1, 6),
    outputs=st.integers(1, 6),
    fraction=st.floats(0, 1),
)
def test_no_factor_comes_nearer_and_no_equally_near_one_is_smaller(
    hidden, inputs, outputs, fraction
):
    count = parameters_of(inputs, outputs)
    target = 1 + round(fraction * (count(hidden) - 1))
    best = min((abs(count(widths) - target), count(widths)) for widths in all_scaled(hidden))
    widths, achieved = equivalent_widths(hidden, count, target)
    assert achieved == count(widths)
    assert (abs(achieved - target), achieved) == best
    assert tuple(widths) in all_scaled(hidden)


def test_halfcheetah_actor_at_90_per_cent_by_hand():
    # 1893 + 3549 + 1858 connections and 524 biases. A dense w, w has w^2 + 31 w + 12 parameters:
    # 7782 with 74 and 7962 with 75.
    widths = equivalent_widths([256, 256], parameters_of(17, 12), 7824)
    assert widths == ([74, 74], 7782)
