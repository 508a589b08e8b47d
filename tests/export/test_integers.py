"""Policies whose linear layers compute with whole numbers."""

import subprocess

import numpy as np
import pytest
import torch as th
from export.tools import COMPILER, Task, chain, compiles, linear, random_chain, relu
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from support import TinyImages, make

from sb3_sparse.errors import ConfigError, UnsupportedError
from sb3_sparse.export import Returns, export_policy, record_observations
from sb3_sparse.export.c import write_c
from sb3_sparse.export.calibrate import integer_graph
from sb3_sparse.export.compiler import OPTIONS, compiled
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.fold import fold
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.inexact import adopted, inexact_quantizations
from sb3_sparse.export.integers import Dequantized, Lookup, Quantize, Requantized
from sb3_sparse.export.nodes import Activation, Add, Clip, Conv, Flatten, Standardize
from sb3_sparse.export.quantize import quantized
from sb3_sparse.export.reference import predictor, rounded
from sb3_sparse.export.returns import play_both
from sb3_sparse.export.units import remove_dead_units

MAIN = """
#include <stdio.h>
#include "policy.h"
int main(void) {
    float obs[SB3_SPARSE_OBSERVATION_SIZE], action[SB3_SPARSE_ACTION_SIZE];
    while (fread(obs, sizeof obs, 1, stdin) == 1) {
        sb3_sparse_policy(obs, action);
        fwrite(action, sizeof action, 1, stdout);
    }
    return 0;
}
"""
HOSTILE = [0.0, -0.0, 1e-45, 3e38, -3e38, np.inf, -np.inf, np.nan, 0.5, -0.5, 1e5]
"""Numbers that must not lead to undefined behaviour."""


def program(graph, observations, folder, *options):
    """Actions of a policy compiled to a program of its own."""
    source = write_c(graph, "0", True)
    for name, text in {
        "main.c": MAIN,
        "policy.c": source.source,
        "policy.h": source.header,
    }.items():
        (folder / name).write_text(text)
    files = [str(folder / "main.c"), str(folder / "policy.c")]
    built = [COMPILER, *OPTIONS, *options, *files, "-lm", "-o", str(folder / "main")]
    subprocess.run(built, check=True)
    given = np.ascontiguousarray(observations, np.float32).tobytes()
    done = subprocess.run([str(folder / "main")], input=given, capture_output=True, check=True)
    assert done.stderr == b""
    return np.frombuffer(done.stdout, np.float32).reshape(len(observations), -1)


def by_loops(graph, observation):
    """One action by Python's whole numbers, which have no width: the formulas of the nodes."""
    values = [[np.float32(x) for x in np.reshape(observation, -1)]]
    for node in graph.nodes:
        x = values[node.inputs[0]]
        if isinstance(node, Quantize):
            scaled = [float(a * b) for a, b in zip(x, node.twice, strict=True)]
            inside = [min(max(a, -2.0 * node.most), 2.0 * node.most) for a in scaled]
            y = [(abs(int(a)) + 1) // 2 * (1 if a >= 0 else -1) for a in inside]
        elif isinstance(node, Lookup):
            table = [int(entry) for entry in node.table]
            parts = [divmod(int(a) + 32768, 256) for a in x]
            y = [table[p] + ((table[p + 1] - table[p]) * i + 128) // 256 for p, i in parts]
        else:
            sums = [
                int(bias) + sum(int(w) * int(a) for w, a in zip(row, x, strict=True))
                for row, bias in zip(node.weight, node.bias, strict=True)
            ]
            assert all(abs(total) < 2**31 for total in sums)
            if isinstance(node, Requantized):
                least = 0 if node.relu else -32767
                halved = [a // 2 ** int(s) for a, s in zip(sums, node.shift, strict=True)]
                inside = [min(max(a, least), 32767) for a in halved]
                pairs = zip(inside, node.multiplier, strict=True)
                y = [(a * int(m) + 2**14) // 2**15 for a, m in pairs]
            else:
                assert isinstance(node, Dequantized)
                y = [np.float32(a) * b for a, b in zip(sums, node.scale, strict=True)]
        values.append(y)
    return values[-1]


def check_bounds(graph):
    """No sum of absolute values may exceed 32 bits, nor may a result exceed 16."""
    most = [np.inf]
    for node in graph.nodes:
        reached = most[node.inputs[0]]
        if isinstance(node, Quantize):
            reached = node.most
        elif isinstance(node, Lookup):
            reached = np.abs(node.table.astype(int)).max()
        elif isinstance(node, (Requantized, Dequantized)):
            sums = np.abs(node.weight.astype(int)).sum(axis=1) * int(reached)
            assert (sums + np.abs(node.bias.astype(int))).max() < 2**31
            reached = int(node.multiplier.max()) if isinstance(node, Requantized) else np.inf
        most.append(reached)
        assert not node.whole or reached <= 32767


def with_kinds(graph, kind):
    """The graph with other activations than ReLU."""
    nodes = [
        Activation(node.inputs, node.shape, kind) if isinstance(node, Activation) else node
        for node in graph.nodes
    ]
    return Graph(graph.observation_shape, tuple(nodes), graph.action_shape)


def test_a_network_by_hand():
    graph = chain(1, ([[2]], [1]), ([[3], [-1]], [0, 0.5]))
    whole = integer_graph(graph, np.float32([[-1], [1]]))
    first, hidden, last = whole.nodes
    # Observations reach 1, so 32767 stands for 2, and they are multiplied by 2 * 32767 / 2.
    assert (first.most, first.twice.tolist()) == (32767, [32767.0])
    # The weight becomes 127; 1 in the sum stands for 2 * 2 / 127 / 32767, so 1 for 1040352 of it.
    # ReLU's results reach 3, so 32767 stands for 12. 4 / 127 / 12 = 22017.3 / 2^15 / 2^8.
    assert hidden.weight.tolist() == [[127]]
    assert hidden.bias.tolist() == [1040352 + 2**7]
    assert (hidden.multiplier.tolist(), hidden.shift.tolist()) == ([22017], [8])
    assert hidden.relu
    assert last.weight.tolist() == [[127], [-127]]
    assert last.bias.tolist() == [0, 173392]  # 0.5 * 127 * 32767 / 12
    np.testing.assert_allclose(last.scale, [36 / 127 / 32767, 12 / 127 / 32767], rtol=1e-6)
    # 1 -> 16384 -> (127 * 16384 + 1040480) / 2^8 = 12192 -> 12192 * 22017 / 2^15 = 8192
    values = whole.values(np.float32([[1], [-1]]))
    assert [value[:, 0].tolist() for value in values[1:3]] == [[16384], [8192]]
    assert values[2][0, 1] == 0  # -2 + 1 is negative
    expected = np.float32([127 * 8192, -127 * 8192 + 173392]) * last.scale
    np.testing.assert_array_equal(whole.run(np.float32([[1]]))[0], expected)
    np.testing.assert_allclose(expected, [9, -2.5], atol=1e-3)
    assert compiled(write_c(whole, "0", True).source, whole)(np.float32([[1]]))[0].tolist() == (
        expected.tolist()
    )


def test_numbers_are_rounded_halves_away_from_0_and_clipped():
    node = Quantize((0,), (6,), np.float32([2, 2, 2, 2, 2, 2]), 100)
    assert node.run(np.float32([[0.5, -0.5, 0.49, -1.49, 1e9, np.nan]]).T)[:, 0].tolist() == [
        *[1, -1, 0, -1],
        *[100, 100],
    ]


def test_a_table_is_exact_at_its_points_and_straight_between():
    table = np.zeros(257, np.int16)
    table[128:131] = [10, 20, -40]
    node = Lookup((0,), (5,), table)
    assert node.run(np.array([[0, 256, 128, 384, 511]]).T)[:, 0].tolist() == [10, 20, 15, -10, -40]


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    sizes=st.lists(st.integers(1, 40), min_size=2, max_size=4),
    density=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    kind=st.sampled_from(["relu", "tanh", "sigmoid", "gelu", "silu"]),
    span=st.sampled_from([1e-6, 1.0, 1e4]),
)
def test_numpy_and_c_compute_what_whole_numbers_without_width_do(seed, sizes, density, kind, span):
    random = np.random.default_rng(seed)
    graph = with_kinds(random_chain(random, sizes, density), kind)
    seen = (span * random.normal(size=(30, sizes[0]))).astype(np.float32)
    whole = integer_graph(graph, seen)
    check_bounds(whole)
    given = np.concatenate([seen, 5 * seen])
    found = whole.run(given)
    assert found.dtype == np.float32
    expected = [by_loops(whole, observation) for observation in given]
    np.testing.assert_array_equal(found, np.reshape(expected, found.shape))
    act = compiled(write_c(whole, "0", True).source, whole)
    np.testing.assert_array_equal(act(given), found)


@pytest.mark.parametrize("options", [["-O2"], ["-O3", "-march=native"], ["-m32"]], ids=str)
def test_every_target_computes_the_same(options, tmp_path):
    check = subprocess.run(
        [COMPILER, *options, "-x", "c", "-", "-o", "/dev/null"],
        input='#include <stdio.h>\nint main(void) { return puts("") < 0; }\n',
        text=True,
        capture_output=True,
    )
    if check.returncode:
        pytest.skip(f"the compiler cannot {options[0]} here (Debian: gcc-multilib)")
    random = np.random.default_rng(1)
    seen = random.normal(size=(300, 9)).astype(np.float32)
    whole = integer_graph(random_chain(random, [9, 70, 300, 20, 3], 0.2), seen)
    np.testing.assert_array_equal(program(whole, 4 * seen, tmp_path, *options), whole.run(4 * seen))


@pytest.mark.parametrize("kind", ["relu", "tanh"])
def test_no_observation_leads_to_undefined_behaviour(kind, tmp_path):
    random = np.random.default_rng(2)
    seen = np.ones((20, 4), np.float32) * random.normal(size=(20, 1)).astype(np.float32)
    weights = np.full((300, 4), 1.0)  # inputs and weights that all add up
    chained = chain(4, (weights, np.full(300, 9.0)), (np.ones((2, 300)), [1e6, 0]))
    whole = integer_graph(with_kinds(chained, kind), seen)
    check_bounds(whole)
    hostile = np.float32([np.roll(HOSTILE, shift)[:4] for shift in range(len(HOSTILE))])
    hostile = np.concatenate([hostile, np.repeat(np.float32(HOSTILE)[:, None], 4, axis=1)])
    options = ["-fsanitize=undefined", "-fno-sanitize-recover=all"]
    found = program(whole, hostile, tmp_path, *options)
    np.testing.assert_array_equal(found, whole.run(hostile))
    assert np.isfinite(found).all()


def test_wide_layers_have_inputs_of_fewer_bits_so_that_no_sum_overflows():
    random = np.random.default_rng(3)
    seen = random.normal(size=(5, 3)).astype(np.float32)
    graph = chain(3, (random.normal(size=(3000, 3)), np.zeros(3000)), (np.ones((1, 3000)), [0]))
    whole = integer_graph(graph, seen)
    check_bounds(whole)
    assert whole.nodes[1].multiplier.max() <= (2**30 - 1) // (127 * 3000) < 2**12
    np.testing.assert_allclose(whole.run(seen), graph.run(seen), rtol=0.001)
    widest = chain(66_000, (np.ones((1, 66_000)), [0]))  # 66,000 * 127 * 127 < 2^30
    check_bounds(integer_graph(widest, np.ones((2, 66_000))))
    with pytest.raises(UnsupportedError, match="may exceed 32 bits; export it with int8='weights'"):
        integer_graph(chain(67_000, (np.ones((1, 67_000)), [0])), np.ones((2, 67_000)))


@pytest.mark.parametrize("seed", range(20))
def test_weights_halfway_between_two_numbers_stay_within_the_bounds_too(seed):
    """Largest weight 127, others whole or half: whichever way halves go, the sums must hold."""
    random = np.random.default_rng(seed)
    weight = random.integers(-254, 255, size=(2, 3000)) / 2
    weight[:, 0] = 127
    bias = random.normal(size=2) * [1.0, 1e9]
    seen = random.uniform(0.1, 3) * np.float32([np.ones(3000), -np.ones(3000)])
    whole = integer_graph(chain(3000, (weight, bias), (weight[:, :2], bias)), seen)
    check_bounds(whole)
    first, hidden, _ = whole.nodes
    sums = np.abs(hidden.weight.astype(int)).sum(axis=1) * first.most
    assert sums.max() <= 2**30 - 1
    half = np.where(hidden.shift > 0, 2.0 ** (hidden.shift - 1.0), 0)
    assert np.abs(hidden.bias - half).max() <= 2**29 - 1


def test_values_up_to_twice_those_seen_are_not_clipped():
    random = np.random.default_rng(4)
    graph = random_chain(random, [3, 50, 2], 1.0)
    seen = random.uniform(-1, 1, size=(500, 3)).astype(np.float32)
    seen[:2] = [[1, 1, 1], [-1, -1, -1]]
    whole = integer_graph(graph, seen)
    near, far = (np.abs(whole.run(k * seen) - graph.run(k * seen)).max() / k for k in (1.9, 20))
    assert near < 0.1 < far


def test_inputs_have_ranges_of_their_own():
    graph = chain(3, ([[1, 1000, 1]], [0]))
    seen = np.float32([[1, 0.001, 7], [-1, -0.001, 7], [0.5, 0.0005, 7]])
    whole = integer_graph(graph, seen)
    # Twice what was seen; the third never moved, so it gets what it showed, above the median.
    np.testing.assert_allclose(2 * 32767 / whole.nodes[0].twice, [2, 0.002, 14], rtol=1e-6)
    given = np.float32([[0.1, 0.0009, 7], [-0.7, 0.0003, 7]])
    np.testing.assert_allclose(whole.run(given), graph.run(given), atol=0.02)


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        *[(kind, {}) for kind in ("tanh", "sigmoid", "silu", "gelu", "gelu_tanh", "mish")],
        *[(kind, {}) for kind in ("softsign", "hardswish", "tanhshrink")],
        *[("leaky_relu", {"slope": 0.1}), ("elu", {"slope": 1.0}), ("softshrink", {"most": 0.5})],
    ],
)
def test_every_activation_is_a_table(kind, parameters):
    x = np.linspace(-4, 4, 400, dtype=np.float32)[:, None]
    eye = np.ones((1, 1))
    nodes = (linear(0, eye), Activation((1,), (1,), kind, parameters), linear(2, eye))
    graph = Graph((1,), nodes, (1,))
    whole = integer_graph(graph, x)
    assert [type(node) for node in whole.nodes] == [Quantize, Requantized, Lookup, Dequantized]
    np.testing.assert_allclose(whole.run(x), graph.run(x), atol=0.004)


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [("threshold", {"most": 0.1, "instead": 0.0}), ("hardshrink", {"most": 0.5})],
)
def test_what_is_no_table_stays_a_float(kind, parameters):
    middle = Activation((1,), (1,), kind, parameters)
    graph = Graph((1,), (linear(0, [[1]]), middle, linear(2, [[1]])), (1,))
    kinds = [type(node) for node in integer_graph(graph, np.float32([[-1], [1]])).nodes]
    assert kinds == [Quantize, Dequantized, Activation, Quantize, Dequantized]


def test_a_residual_connection_and_a_norm_stay_floats():
    inner = (linear(1, [[1, 0], [0, 1]]), relu(2, 2), linear(3, [[1, 0], [0, 1]]))
    nodes = (linear(0, [[1], [2]]), *inner, Add((1, 4), (2,)), Standardize((5,), (2,), 1e-5))
    graph = Graph((1,), (*nodes, linear(6, [[1, 2]])), (1,))
    seen = np.float32([[-1], [1], [0.3]])
    whole = integer_graph(graph, seen)
    assert [type(node) for node in whole.nodes] == [
        *[Quantize, Dequantized, Quantize, Requantized, Dequantized, Add, Standardize],
        *[Quantize, Dequantized],
    ]
    np.testing.assert_allclose(whole.run(seen), graph.run(seen), atol=0.015)
    act = compiled(write_c(whole, "0", True).source, whole)
    np.testing.assert_allclose(act(seen), whole.run(seen), atol=1e-6)


def test_rows_without_weights_and_with_large_biases():
    seen = np.float32([[-1], [1]])
    graph = chain(1, ([[0], [0], [1e-4], [1]], [0, 5, 5000, 0]), ([[1, 1, 1, 1]], [-5005]))
    whole = integer_graph(graph, seen)
    check_bounds(whole)
    assert not whole.nodes[1].weight[:2].any()
    np.testing.assert_allclose(whole.run(seen), graph.run(seen), atol=0.5)


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("algorithm", ["SAC", "TD3", "PPO", "DQN"])
def test_policies_of_every_kind_and_storage(algorithm, compute, tmp_path):
    model = make(algorithm, policy_kwargs={"sparsity": 0.6, "compute": compute})
    seen = record_observations(model, model.get_env(), 200)
    floats = export_policy(model, tmp_path / "floats")
    report = export_policy(model, tmp_path / "policy", int8="full", observations=seen)
    assert report.parity.holds
    assert report.parity.random == 1000
    assert (report.rounding.recorded, report.rounding.random) == (200, 0)
    if report.rounding.discrete:
        assert report.rounding.different <= 1
    else:
        assert 0 < report.rounding.difference < 0.01
    assert "int8 against float32: " in str(report)
    source = (tmp_path / "policy.c").read_text()
    tables = 2 * 257 * source.count("static const int16_t table_")
    assert report.sizes["flash"] - tables < floats.sizes["flash"] / 1.7
    assert compiles(tmp_path / "policy.c", "-Wconversion", "-Wshadow", "-O2") == ""
    export_policy(model, tmp_path / "policy", int8="full", observations=seen)
    assert (tmp_path / "policy.c").read_text() == source


@pytest.mark.parametrize(
    ("model", "most"),
    [
        (lambda: make("PPO", TinyImages(False)), 1e-4),
        (lambda: make("SAC", policy="SparseSimbaPolicy", policy_kwargs={"sparsity": 0.5}), 0.03),
    ],
    ids=["images", "simba"],
)
def test_convolutions_and_norms_stay_floats(model, most, tmp_path):
    model = model()
    seen = record_observations(model, model.get_env(), 50)
    report = export_policy(model, tmp_path / "policy", int8="full", observations=seen)
    assert report.parity.holds
    assert report.rounding.difference < most


@pytest.mark.parametrize("side", [36, 48])
def test_floats_that_are_added_up_in_another_order_are_no_difference(side, tmp_path):
    """Each last bit may move a whole number by a step, which an action layer of gain 1 shows."""
    env = TinyImages(False)
    env.observation_space = spaces.Box(0, 255, (side, side, 1), np.uint8)
    model = make("PPO", env)
    th.nn.init.orthogonal_(model.policy.action_net.weight, 1.0)
    seen = record_observations(model, model.get_env(), 50)
    report = export_policy(model, tmp_path / "policy", int8="full", observations=seen)
    assert report.parity.holds

    whole = quantized(integer_graph(remove_dead_units(fold(graph_of(model, None))), seen))
    source = (tmp_path / "policy.c").read_text()
    right = compiled(source, whole)
    steps = np.abs(right(seen) - whole.run(seen))
    assert 1e-5 < steps.max() < 1e-3  # the same, were it not for these steps
    np.testing.assert_allclose(right(seen), rounded(whole, right)(seen), atol=1e-5)
    cut = source.replace("(twofold + (twofold < 0 ? -1 : 1)) / 2", "twofold / 2")
    wrong = compiled(cut, whole)  # cuts where it should round
    assert np.abs(wrong(seen) - rounded(whole, wrong)(seen)).max() > 1e-5


def test_which_whole_numbers_may_differ():
    def quantize(value):
        return Quantize((value,), (2,), np.float32([2, 2]), 100)

    eye = [[1, 0], [0, 1]]
    kernel, bias = np.ones((2, 1, 1, 1), np.float32), np.zeros(2)
    clip = Clip((0,), (2,), np.zeros(2), np.ones(2))
    exact = [quantize(0)], [clip, quantize(1)], [relu(0, 2), quantize(1)]
    for nodes in exact:
        assert inexact_quantizations(Graph((2,), tuple(nodes))) == []
    conv = Conv((0,), (2, 1, 1), kernel, bias, (1, 1), (0, 0))
    tanh, sums = Activation((0,), (2,), "tanh"), linear(0, eye)
    assert inexact_quantizations(Graph((1, 1, 1), (conv, Flatten((1,), (2,)), quantize(2)))) == [3]
    for nodes in [tanh, quantize(1)], [sums, relu(1, 2), quantize(2)]:
        assert inexact_quantizations(Graph((2,), tuple(nodes))) == [len(nodes)]
    table = Lookup((2,), (2,), np.zeros(257, np.int16))
    assert inexact_quantizations(Graph((2,), (sums, quantize(1), table, quantize(3)))) == [2]


def test_another_s_number_is_taken_where_its_float_may_be_the_same():
    node = Quantize((0,), (5,), np.full(5, 2, np.float32), 1000)
    floats = np.float32([[0.5, 0.5, 0.498, 0.48, 5000]]).T  # a step is 1, and 1e-5 of 1000 is 0.01
    other = np.array([[0, 1, 1, 1, 999]]).T
    assert node.run(floats)[:, 0].tolist() == [1, 1, 0, 0, 1000]
    assert adopted(node, floats, other, 1e-5)[:, 0].tolist() == [0, 1, 1, 0, 1000]


def test_the_array_that_a_check_reads_costs_a_policy_nothing(tmp_path):
    images = make("PPO", TinyImages(False))
    seen = record_observations(images, images.get_env(), 20)
    export_policy(images, tmp_path / "policy", int8="full", observations=seen)
    symbols = {}
    for options in ([], ["-DSB3_SPARSE_CHECK"]):
        compiles = [COMPILER, *OPTIONS, *options, "-c", str(tmp_path / "policy.c"), "-o"]
        subprocess.run([*compiles, str(tmp_path / "policy.o")], check=True)
        said = subprocess.run(
            ["nm", "-g", "--defined-only", str(tmp_path / "policy.o")],
            capture_output=True,
            text=True,
        )
        symbols[len(options)] = {line.split()[-1] for line in said.stdout.splitlines()}
    assert symbols[0] == {"sb3_sparse_policy"}
    assert symbols[1] == {"sb3_sparse_policy", "sb3_sparse_quantized"}
    for model in (make("SAC"), make("PPO")):  # whose sums are all of whole numbers
        seen = record_observations(model, model.get_env(), 20)
        export_policy(model, tmp_path / "policy", int8="full", observations=seen)
        assert "SB3_SPARSE_CHECK" not in (tmp_path / "policy.c").read_text()


def test_the_return_is_reported_and_normalised_observations_are_taken_raw(tmp_path):
    env = VecNormalize(make("SAC").get_env())
    model = make("SAC", env)
    model.learn(150)
    env.training, env.norm_reward = False, False
    seen = record_observations(model, env, 200)
    options = dict(int8="full", observations=seen, eval_env=env)
    report = export_policy(model, tmp_path / "policy", **options)
    assert len(report.returns.float32) == len(report.returns.int8) == 20
    differences = np.subtract(report.returns.float32, report.returns.int8)
    assert 0 < np.abs(differences).max() < 2  # the same pendulums, and almost the same torques
    assert np.std(report.returns.float32) > 100
    assert f"return: {report.returns}" in str(report)


@pytest.mark.parametrize("env", [TinyImages(), "CartPole-v1"], ids=["images", "numbers"])
def test_returns_of_equal_policies_are_equal(env):
    model = make("DQN", env)
    own, envs = predictor(model, None), model.get_env()
    returns = play_both(own, own, envs, model.observation_space, model.action_space)
    assert returns.float32 == returns.int8
    assert len(set(returns.int8)) > 1


def test_returns_as_text():
    assert str(Returns((1.0, 3.0), (2.0, 2.0))).startswith("2.00 ± 1.00 by the model, 2.00 ± 0.00")


def test_errors(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "no-such-compiler")  # which nothing here gets as far as
    model = make("SAC")
    env = VecNormalize(DummyVecEnv([lambda: model.get_env().envs[0]]))
    images = DummyVecEnv([TinyImages])
    other = DummyVecEnv([lambda: Task(model.observation_space, spaces.Discrete(2))])
    for options, message in [
        (dict(int8="full"), "int8='full' takes the ranges .* recorded observations; give"),
        (dict(int8="half"), "unknown value of int8 'half'; allowed are weights, full"),
        (dict(int8="full", to="numpy"), "int8 is for to='c' only, got to='numpy'"),
        (dict(eval_env=env), "eval_env shows what int8 does to the return; give int8, too"),
        (dict(eval_env=env, int8=True), "the evaluation environment normalises rewards"),
        (dict(eval_env=images, int8=True), r"environment shows observations of shape \(36, 36, 1"),
        (dict(eval_env=other, int8=True), r"takes actions in Discrete\(2\), the model chooses"),
        *[
            (
                dict(int8=int8, observations=np.zeros((0, 3))),
                "recorded observations are empty; give",
            )
            for int8 in (False, True, "full")
        ],
    ]:
        with pytest.raises(ConfigError, match=message):
            export_policy(model, tmp_path / "policy", **options)
    assert not list(tmp_path.iterdir())


def test_weights_alone_are_what_true_means(tmp_path):
    model = make("SAC")
    for name, int8 in {"one": True, "other": "weights"}.items():
        export_policy(model, tmp_path / name / "policy.c", int8=int8)
    one, other = ((tmp_path / name / "policy.c").read_text() for name in ("one", "other"))
    assert one == other


def test_whole_numbers_add_little_to_the_rounding_of_weights():
    random = np.random.default_rng(5)
    graph = random_chain(random, [17, 256, 256, 6], 0.05)
    seen = random.normal(size=(400, 17)).astype(np.float32)
    exact, whole = graph.run(seen), integer_graph(graph, seen).run(seen)
    weights = quantized(graph).run(seen)
    assert np.abs(whole - exact).mean() < 1.01 * np.abs(weights - exact).mean()


def test_a_policy_with_a_tanh_between_needs_no_math_library(tmp_path):
    model = make("PPO")  # its networks have tanh
    seen = record_observations(model, model.get_env(), 100)
    export_policy(model, tmp_path / "policy", int8="full", observations=seen)
    assert "math.h" not in (tmp_path / "policy.c").read_text()
    assert any(node.name == "tanh" for node in graph_of(model, None).nodes)
