"""Graphs of several outputs by hand: what they compute, keep and need, in every format."""

import numpy as np
import pytest
from export.tools import compiles, linear, relu

from sb3_sparse.export.artifact import GRAPH_ARTIFACTS
from sb3_sparse.export.c import write_c
from sb3_sparse.export.fold import fold
from sb3_sparse.export.graph import Graph, Output
from sb3_sparse.export.nodes import Affine, Concat
from sb3_sparse.export.output_nodes import Constant, Largest, Minimum
from sb3_sparse.export.units import remove_dead_units


def several():
    """Two estimates, the smaller of them, the largest of three scores, and a constant."""
    scores = linear(0, [[1, 0], [0, 1], [1, 1]])
    smaller = Minimum((2, 3), (1,))
    nodes = (
        scores,
        linear(1, [[1, 1, 0]]),
        linear(1, [[0, 0, 3]], [1]),
        smaller,
        Largest((1,), (1,)),
        Constant((0,), (2,), np.float32([0.25, -7])),
    )
    outputs = [("action", 1, (3,)), ("value", 4, ()), ("mean", 5, ()), ("std", 6, (2,))]
    chosen = tuple(Output(*output, "by hand") for output in outputs)
    return Graph((2,), nodes, (3,), chosen=chosen)


@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_several_outputs_by_hand(to):
    seen = np.float32([[1, 2], [-3, 1], [-1, -2]])
    expected = [
        [1, 2, 3, 3, 3, 0.25, -7],
        [-3, 1, -2, -5, 1, 0.25, -7],
        [-1, -2, -3, -8, -1, 0.25, -7],
    ]
    graph = several()
    np.testing.assert_array_equal(graph.run(seen), expected)
    np.testing.assert_array_equal(GRAPH_ARTIFACTS[to](graph, False).actor()(seen), expected)


def test_the_header_names_outputs_and_their_sizes(tmp_path):
    written = write_c(several(), "0")
    for line in (
        "#define SB3_SPARSE_ACTION_SIZE 3\n#define SB3_SPARSE_VALUE_SIZE 1\n",
        "#define SB3_SPARSE_MEAN_SIZE 1\n#define SB3_SPARSE_STD_SIZE 2\n\n",
        "(const float *obs, float *action, float *value, float *mean, float *std);\n",
        " * value: 1 number, by hand.\n * mean: 1 number, by hand.\n * std: 2 numbers, by hand.\n",
    ):
        assert line in written.header
    (tmp_path / "policy.c").write_text(written.source)
    assert compiles(tmp_path / "policy.c") == ""
    assert written.ram == 8  # two estimates; all other values are outputs


def test_units_that_only_a_further_output_reads_stay():
    first = linear(0, [[1, 0], [0, 1], [2, 2]], [0, 0, 0])
    nodes = (first, relu(1, 3), linear(2, [[1, 0, 0]]), linear(2, [[0, 5, 0]], [1]))
    chosen = (Output("action", 3, (1,)), Output("value", 4, ()))
    graph = Graph((2,), nodes, (1,), chosen=chosen)
    small = remove_dead_units(graph)
    assert [layer.weight.tolist() for layer in small.layers] == [
        [[1, 0], [0, 1]],
        [[1, 0]],
        [[0, 5]],
    ]
    np.testing.assert_array_equal(small.run(np.float32([[3, 4]])), [[3, 21]])
    alone = remove_dead_units(fold(Graph((2,), nodes[:3], (1,))))
    assert [len(layer.bias) for layer in alone.layers] == [1, 1]


def test_constant_units_of_an_output_stay():
    nodes = (linear(0, [[0, 0], [1, 0]], [7, 0]), Concat((0, 1), (4,)), linear(2, [[0, 1, 1, 1]]))
    graph = Graph((2,), nodes, (2,), chosen=(Output("action", 1, (2,)), Output("value", 3, ())))
    small = remove_dead_units(graph)
    np.testing.assert_array_equal(small.run(np.float32([[3, 4]])), [[7, 3, 14]])


def test_a_scale_is_not_folded_into_an_output():
    double = Affine((1,), (1,), np.float32([2]), np.float32([1]))
    nodes = (linear(0, [[3]]), double, linear(2, [[5]]))
    outputs = (Output("action", 3, (1,)), Output("mean", 1, (1,)), Output("std", 2, (1,)))
    graph = fold(Graph((1,), nodes, (1,), chosen=outputs))
    np.testing.assert_array_equal(graph.run(np.float32([[1]])), [[35, 3, 7]])
    one = fold(Graph((1,), nodes, (1,), chosen=outputs[:2]))
    assert [node.op for node in one.nodes] == ["linear", "linear"]
    np.testing.assert_array_equal(one.run(np.float32([[1]])), [[35, 3]])
