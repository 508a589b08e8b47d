"""Folding and dead units, on networks small enough to do by hand."""

import numpy as np
import pytest
from export.tools import chain, linear, random_chain, relu
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_sparse.export.fold import fold
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Add, Affine, Conv, Flatten, Linear, MaxPool
from sb3_sparse.export.units import remove_dead_units, sort_units, units_of


def conv(value, shape, weight, bias, padding=0, stride=1):
    weight = np.array(weight, np.float32)
    return Conv(
        (value,), shape, weight, np.array(bias, np.float32), (stride, stride), (padding, padding)
    )


def test_units_without_inputs_become_part_of_the_next_bias():
    # Unit 0 reads nothing: relu(2) = 2; unit 1 reads nothing: relu(-3) = 0; unit 2 reads x1.
    graph = chain(2, ([[0, 0], [0, 0], [0, 5]], [2, -3, 1]), ([[4, 7, 6], [0, 0, 8]], [10, 20]))
    small = remove_dead_units(graph)
    hidden, _, last = small.nodes
    np.testing.assert_array_equal(hidden.weight, [[0, 5]])
    np.testing.assert_array_equal(hidden.bias, [1])
    np.testing.assert_array_equal(last.weight, [[6], [8]])
    np.testing.assert_array_equal(last.bias, [10 + 4 * 2 + 7 * 0, 20])
    assert units_of(graph) - units_of(small) == 2
    assert small.nnz == 3


def test_constants_go_through_several_layers():
    # The first layer is constant, so is the second: relu(3 * 2 - 1) = 5; 5 * 7 + 1 = 36.
    graph = chain(1, ([[0]], [2]), ([[3]], [-1]), ([[7]], [1]))
    small = remove_dead_units(graph)
    assert small.nnz == 0
    np.testing.assert_array_equal(small.run(np.zeros((2, 1))), [[36], [36]])


def test_units_that_nothing_reads_vanish_with_all_that_only_they_read():
    graph = chain(
        2,
        ([[1, 0], [0, 1]], [0, 0]),
        ([[1, 0], [0, 1]], [0, 0]),
        ([[1, 0]], [0]),  # reads unit 0 only
    )
    small = remove_dead_units(graph)
    assert [layer.weight.shape for layer in small.layers] == [(1, 2), (1, 1), (1, 1)]


def test_outputs_stay_though_they_are_constant():
    small = remove_dead_units(chain(1, ([[1]], [0]), ([[0], [3]], [4, 5])))
    np.testing.assert_array_equal(small.run([[2.0]]), [[4, 5 + 3 * 2]])


def test_a_constant_channel_is_folded_where_there_is_no_border():
    # Channel 0 is 2 everywhere. Two kernel places of a 1x2 kernel: 2 * (3 + 4) = 14.
    first = conv(0, (2, 1, 3), [[[[0]]], [[[1]]]], [2, 0])
    second = conv(1, (1, 1, 2), [[[[3, 4]], [[1, 0]]]], [1])
    graph = Graph((1, 1, 3), (first, second, Flatten((2,), (2,))), (2,))
    small = remove_dead_units(graph)
    assert small.layers[0].weight.shape == (1, 1, 1, 1)
    np.testing.assert_array_equal(small.layers[1].bias, [15])
    np.testing.assert_array_equal(small.run([[[[5, 6, 7]]]]), [[20, 21]])


def test_a_constant_channel_stays_where_a_border_of_zeros_meets_it():
    first = conv(0, (2, 3, 3), [[[[0]]], [[[1]]]], [2, 0])
    second = conv(1, (1, 3, 3), [[np.ones((3, 3)), np.ones((3, 3))]], [0], padding=1)
    graph = Graph((1, 3, 3), (first, second, Flatten((2,), (9,))), (9,))
    small = remove_dead_units(graph)
    assert small.layers[0].weight.shape[0] == 2
    image = np.arange(9.0).reshape(1, 1, 3, 3)
    corner = (0 + 1 + 3 + 4) + 4 * 2  # four pixels and four times the constant
    assert small.run(image)[0, 0] == corner
    np.testing.assert_array_equal(small.run(image), graph.run(image))


def test_the_ends_of_a_residual_connection_keep_their_units():
    first = linear(0, [[0], [1]], [5, 0])
    inner = linear(2, [[0, 0], [1, 0]], [0, 0])
    graph = Graph((1,), (first, relu(1, 2), inner, Add((2, 3), (2,)), linear(4, [[1, 1]])), (1,))
    small = remove_dead_units(graph)
    # 5 + 0, and x + 5 * 1
    np.testing.assert_array_equal(small.run([[3.0]]), [[5 + 3 + 5]])


def test_a_scale_before_a_layer_goes_into_its_columns():
    scale = Affine((0,), (2,), np.float32([2, 3]), np.float32([10, 20]))
    graph = fold(Graph((2,), (scale, linear(1, [[1, 4]], [5])), (1,)))
    (layer,) = graph.nodes
    np.testing.assert_array_equal(layer.weight, [[2, 12]])
    np.testing.assert_array_equal(layer.bias, [5 + 1 * 10 + 4 * 20])


def test_a_scale_behind_a_layer_goes_into_its_rows():
    scale = Affine((1,), (2,), np.float32([2, 3]), np.float32([10, 20]))
    graph = fold(Graph((1,), (linear(0, [[1], [4]], [5, 6]), scale), (2,)))
    (layer,) = graph.nodes
    np.testing.assert_array_equal(layer.weight, [[2], [12]])
    np.testing.assert_array_equal(layer.bias, [2 * 5 + 10, 3 * 6 + 20])


def test_a_shift_does_not_go_past_a_border_of_zeros():
    shift = Affine((0,), (1, 2, 2), np.float32([1]), np.float32([7]))
    bordered = conv(1, (1, 2, 2), [[np.ones((3, 3))]], [0], padding=1)
    graph = Graph((1, 2, 2), (shift, bordered, Flatten((2,), (4,))), (4,))
    assert fold(graph).nodes[0] is shift
    scale = Affine((0,), (1, 2, 2), np.float32([2]), np.float32([0]))
    graph = Graph((1, 2, 2), (scale, bordered, Flatten((2,), (4,))), (4,))
    assert len(fold(graph).nodes) == 2


@pytest.mark.parametrize("padding", [0, 1])
def test_pools_take_the_largest_of_what_is_there(padding):
    pool = MaxPool((0,), (1, 2, 2) if padding else (1, 1, 1), (3, 3), (2, 2), (padding, padding))
    graph = Graph((1, 3, 3), (pool, Flatten((1,), (int(np.prod(pool.shape)),))), (1,))
    image = -np.arange(1.0, 10.0).reshape(1, 1, 3, 3)  # the border must not win
    assert graph.run(image).tolist() == ([[-1, -2, -4, -5]] if padding else [[-1]])


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 10_000),
    sizes=st.lists(st.integers(1, 12), min_size=2, max_size=5),
    density=st.floats(0, 1),
)
def test_both_passes_change_nothing_but_the_size(seed, sizes, density):
    random = np.random.default_rng(seed)
    graph = random_chain(random, sizes, density)
    observations = random.normal(size=(7, sizes[0]))
    small = remove_dead_units(graph)
    in_order = sort_units(small)
    expected = graph.run(observations)
    np.testing.assert_allclose(small.run(observations), expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(in_order.run(observations), expected, rtol=1e-4, atol=1e-4)
    assert small.nnz <= graph.nnz
    for layer in in_order.layers[:-1]:
        counts = np.count_nonzero(layer.weight, axis=1)
        assert (np.diff(counts) >= 0).all()
    for before, after in zip(small.layers, small.layers[1:], strict=False):
        if small.nnz and len(before.bias) > 1:  # every unit that is left does something
            assert (np.count_nonzero(before.weight, axis=1) > 0).all()
            assert (np.count_nonzero(after.weight, axis=0) > 0).all()
    assert all(isinstance(layer, Linear) for layer in small.layers)
