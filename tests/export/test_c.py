"""What the C files hold, and that compilers of all kinds take them."""

import re
import subprocess
from itertools import product

import numpy as np
import pytest
from export.tools import COMPILER, chain, compiles, linear, random_chain, relu
from hypothesis import given, settings
from hypothesis import strategies as st
from support import TinyImages, make

from sb3_sparse.export import export_policy
from sb3_sparse.export.c import write_c
from sb3_sparse.export.compiler import OPTIONS, compiled
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.layout import grouped, index_bits, is_smaller_dense
from sb3_sparse.export.memory import plan_memory
from sb3_sparse.export.nodes import Add, Conv, Flatten
from sb3_sparse.export.observations import random_observations
from sb3_sparse.export.quantize import quantize_rows, quantized

BYTES = {
    **{"float": 4, "int32_t": 4, "uint32_t": 4, "int16_t": 2, "uint16_t": 2},
    **{"int8_t": 1, "uint8_t": 1},
}


def policies():
    impala = dict(
        features_extractor_class="sb3_sparse.networks.ImpalaCNN",
        features_extractor_kwargs=dict(channels=(2, 3, 4), features_dim=16),
        sparsity=0.5,
    )
    return {
        "vectors": make("SAC"),
        "dense": make("PPO", policy="MlpPolicy"),
        "images": make("DQN", TinyImages()),
        "residual": make("PPO", TinyImages(False), policy_kwargs=impala),
        "simba": make("SAC", policy="SparseSimbaPolicy"),
    }


@pytest.fixture(scope="module")
def models():
    return policies()


KINDS = ["vectors", "dense", "images", "residual", "simba"]
WIDTHS = [False, True, "full"]


def works(*options):
    """Whether the compiler can do without errors what a file for it would need."""
    code = "#include <math.h>\n#include <stdint.h>\nextern float f;\n"
    command = [COMPILER, *options, "-x", "c", "-c", "-", "-o", "/dev/null"]
    return subprocess.run(command, input=code, text=True, capture_output=True).returncode == 0


@pytest.fixture(scope="module")
def written(models, tmp_path_factory):
    """Reports and files of each policy at each width of its weights."""
    found = {}
    for kind, int8 in product(KINDS, WIDTHS):
        path = tmp_path_factory.mktemp("written") / "policy"
        seen = random_observations(models[kind].observation_space, None, 20)
        report = export_policy(models[kind], path, int8=int8, observations=seen)
        found[kind, int8] = report, path.with_suffix(".c")
    return found


@pytest.mark.parametrize("options", [["-O2"], ["-O3", "-Wconversion"], ["-m32", "-O2"]], ids=str)
@pytest.mark.parametrize("int8", WIDTHS)
@pytest.mark.parametrize("kind", KINDS)
def test_no_compiler_warns(written, kind, int8, options):
    if not works(*options):
        pytest.skip(f"the compiler cannot {options[0]} here (Debian: gcc-multilib)")
    _, path = written[kind, int8]
    assert compiles(path, *options) == ""


@pytest.mark.parametrize("int8", WIDTHS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_file_states_its_flash_and_ram(written, kind, int8):
    report, path = written[kind, int8]
    source = path.read_text()
    arrays = re.findall(r"static const (\w+) \w+\[(\d+)\] = \{(.*?)\}", source, re.S)
    assert all(len(numbers.split(",")) == int(size) for _, size, numbers in arrays)
    flash = sum(BYTES[name] * int(size) for name, size, _ in arrays)
    static = re.findall(r"^static (\w+) (?:memory|whole)\[(\d+)\];", source, re.M)
    ram = sum(BYTES[name] * int(size) for name, size in static)
    assert report.sizes == {"flash": flash, "RAM": ram}
    assert f"Flash: {flash} bytes" in source
    assert f"RAM: {ram} bytes" in source
    assert "malloc" not in source


def test_indices_have_16_bits_where_they_fit_and_32_where_not():
    weight = np.zeros((1, 70_000), np.float32)
    weight[0, [1, 69_999]] = [2, 3]
    wide = chain(70_000, (weight, [0.5]))
    source = write_c(wide, "0").source
    assert "uint32_t column_1[2] = {\n    1, 69999\n}" in source
    observations = np.arange(140_000.0).reshape(2, -1) / 70_000
    np.testing.assert_allclose(
        compiled(source, wide)(observations),
        [[0.5 + 2 * o[1] + 3 * o[69_999]] for o in observations],
        rtol=1e-6,
    )
    narrow = write_c(chain(65_535, (weight[:, :65_535], [0.5])), "0").source
    assert "uint16_t column_1" in narrow
    assert "uint32_t column_1" not in narrow


@pytest.mark.parametrize(
    ("columns", "longest", "index"),
    [(256, 2, "uint8_t"), (256, 255, "uint8_t"), (256, 256, "uint16_t"), (257, 2, "uint16_t")],
)
def test_indices_have_8_bits_where_columns_and_lengths_fit(columns, longest, index):
    weight = np.zeros((9, columns), np.float32)
    weight[:8, -2:] = 1, 2
    weight[8, -longest:] = 3
    graph = chain(columns, (weight, np.arange(9.0)))
    source = write_c(graph, "0").source
    assert f"{index} length_1[2]" in source
    assert f"{index} column_1[{16 + longest}]" in source
    observations = np.random.default_rng(0).normal(size=(3, columns)).astype(np.float32)
    expected = observations @ weight.T + np.arange(9)
    np.testing.assert_allclose(compiled(source, graph)(observations), expected, atol=1e-3)


def test_a_layer_that_is_nearly_dense_has_no_indices():
    source = write_c(chain(3, (np.ones((9, 3)), np.zeros(9))), "0").source
    assert "column_1" not in source
    assert "value_1[27]" in source


def test_rows_side_by_side_are_padded_with_zeros_at_a_column_that_they_have():
    rows = np.zeros((9, 4))
    rows[0, 1] = 5
    rows[7, [0, 2]] = [6, 7]
    rows[8, 3] = 8
    lengths, columns, values = grouped(rows)
    assert lengths == [2, 1]  # of eight rows together, then of the ninth
    assert columns.tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 2, 3]
    assert values.tolist() == [5, 0, 0, 0, 0, 0, 0, 6, 0, 0, 0, 0, 0, 0, 0, 7, 8]


def test_eight_bits_by_hand():
    numbers, scale = quantize_rows(
        np.array([[1.27, -0.5, 0.0], [0.0, 0.0, 0.0], [-254.0, 2.9, 1.0]])
    )
    np.testing.assert_allclose(scale, [0.01, 1 / 127, 2.0], rtol=1e-6)
    assert numbers.tolist() == [[127, -50, 0], [0, 0, 0], [-127, 1, 0]]


def test_eight_bit_weights_act_as_the_rounded_weights_do(tmp_path):
    model = make("SAC", policy_kwargs={"sparsity": 0.5})
    report = export_policy(model, tmp_path / "policy", "c", int8=True)
    assert report.parity.difference < 1e-5 < report.rounding.difference < 0.02
    floats = export_policy(model, tmp_path / "floats", "c")
    assert report.sizes["flash"] < floats.sizes["flash"]
    graph = quantized(graph_of(model, None))
    observations = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    np.testing.assert_allclose(
        compiled((tmp_path / "policy.c").read_text(), graph)(observations),
        graph.run(observations),
        atol=1e-5,
    )


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 6))
def test_no_value_is_overwritten_while_it_is_needed(seed, count):
    random = np.random.default_rng(seed)
    sizes = random.integers(1, 20, count + 1).tolist()
    check_memory(random_chain(random, sizes, 0.5))


@pytest.mark.parametrize("kind", KINDS)
def test_no_value_of_a_policy_is_overwritten_while_it_is_needed(models, kind):
    check_memory(graph_of(models[kind], None))


def test_nothing_is_written_over_a_value_that_another_view_of_it_shows():
    layer = Conv((0,), (1, 1, 2), np.ones((1, 1, 1, 1), np.float32), np.zeros(1), (1, 1), (0, 0))
    view = Flatten((1,), (2,))
    below = linear(3, [[1, 0], [0, 1]])
    again = Flatten((1,), (2,))
    graph = Graph((1, 1, 2), (layer, view, relu(2, 2), below, again, Add((4, 5), (2,))), (2,))
    check_memory(graph)
    seen = np.float32([[[[-3.0, 4.0]]]])
    np.testing.assert_array_equal(compiled(write_c(graph, "0").source, graph)(seen), [[-3, 8]])


def test_an_output_that_nothing_would_write_is_refused():
    layer = Conv((0,), (1, 1, 2), np.ones((1, 1, 1, 1), np.float32), np.zeros(1), (1, 1), (0, 0))
    with pytest.raises(AssertionError):
        write_c(Graph((1, 1, 2), (layer, Flatten((1,), (2,))), (2,)), "0")


@pytest.mark.parametrize(("columns", "bits"), [(256, 8), (257, 16), (2**16, 16), (2**16 + 1, 32)])
def test_indices_have_as_many_bits_as_columns_and_lengths_need(columns, bits):
    assert index_bits(columns, longest=1) == bits
    assert index_bits(columns=1, longest=columns - 1) == bits


def test_a_layer_is_dense_where_its_indices_would_cost_more_than_its_zeros():
    rows = np.float32([[1, 2, 0, 0], [3, 4, 5, 0]])  # 8 weights, 5 of them not 0
    assert is_smaller_dense(rows, width=4, bits=32)  # 32 bytes against 5 * 8
    assert not is_smaller_dense(rows, width=4, bits=16)  # 32 against 5 * 6
    assert is_smaller_dense(rows, width=1, bits=8)  # 8 against 10


def check_memory(graph: Graph):
    """Write a value's number into its place; nobody may have overwritten it when it is read."""
    memory = plan_memory(graph)
    floats = np.zeros(memory.size, np.int64)
    names = {0: 0}
    for value, node in enumerate(graph.nodes, start=1):
        for taken in node.inputs:
            if taken in memory.places:
                start = memory.places[taken]
                size = int(np.prod(graph.shape_of(taken)))
                assert (floats[start : start + size] == names[taken]).all()
        view = isinstance(node, Flatten)
        names[value] = names[node.inputs[0]] if view else value
        if value in memory.places and not view:
            start = memory.places[value]
            floats[start : start + int(np.prod(node.shape))] = value
    assert memory.size <= sum(int(np.prod(node.shape)) for node in graph.nodes) * 2


def test_a_main_function_can_step_the_policy(tmp_path):
    model = make("SAC")
    export_policy(model, tmp_path / "policy", "c")
    (tmp_path / "main.c").write_text(
        """
        #include <stdio.h>
        #include "policy.h"
        int main(void) {
            float obs[SB3_SPARSE_OBSERVATION_SIZE] = {0.1f, -0.2f, 0.3f};
            float action[SB3_SPARSE_ACTION_SIZE];
            sb3_sparse_policy(obs, action);
            printf("%.9g", (double)action[0]);
            return 0;
        }
        """
    )
    program = tmp_path / "main"
    files = [str(tmp_path / "main.c"), str(tmp_path / "policy.c")]
    subprocess.run([COMPILER, *OPTIONS, *files, "-lm", "-o", str(program)], check=True)
    said = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    expected, _ = model.predict(np.float32([0.1, -0.2, 0.3]), deterministic=True)
    assert abs(float(said) - expected[0]) < 1e-5
