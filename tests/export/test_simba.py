"""SimBa networks by hand: what a LayerNorm and a residual sum become, and where values lie."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from export.test_c import check_memory
from export.tools import linear, relu
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from support import make
from torch import nn

from sb3_sparse.engine.residual import Residual
from sb3_sparse.errors import UnsupportedError
from sb3_sparse.export import export_policy
from sb3_sparse.export.artifact import GRAPH_ARTIFACTS
from sb3_sparse.export.c import write_c
from sb3_sparse.export.compiler import compiled
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.fold import fold
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.memory import plan_memory
from sb3_sparse.export.nodes import Add, Linear, Standardize
from sb3_sparse.export.quantize import quantized
from sb3_sparse.export.trace import Tracer
from sb3_sparse.export.units import remove_dead_units

SEEN = np.float32([[1, 2, 3, 6]])


def block_by_hand():
    """``x + 2 norm(x) + 100`` of four units.

    Of 1, 2, 3, 6 the mean is 3, and the differences are -2, -1, 0, 3 with variance 14 / 4. With
    eps = 0.5 the deviation is 2, so -1, -0.5, 0, 1.5; scaled and shifted: 9, 19, 30, 46.
    """
    norm, layer = nn.LayerNorm(4, eps=0.5), nn.Linear(4, 4)
    with th.no_grad():
        norm.weight.copy_(th.tensor([1.0, 2, 3, 4]))
        norm.bias.copy_(th.tensor([10.0, 20, 30, 40]))
        layer.weight.copy_(2 * th.eye(4))
        layer.bias.fill_(100)
    tracer = Tracer((4,))
    tracer.walk(Residual(norm, layer), 0)
    return Graph((4,), tracer.finish(), (4,))


BY_HAND = [[1 + 18 + 100, 2 + 38 + 100, 3 + 60 + 100, 6 + 92 + 100]]


@pytest.mark.parametrize("int8", [False, True])
@pytest.mark.parametrize("to", GRAPH_ARTIFACTS)
def test_a_block_by_hand(to, int8):
    graph = fold(block_by_hand())
    assert [node.op for node in graph.nodes] == ["standardize", "linear", "add"]
    found = GRAPH_ARTIFACTS[to](graph, int8).actor()(SEEN)  # 8 bits hold one weight a row
    np.testing.assert_allclose(found, BY_HAND, rtol=1e-6)


def test_scale_and_shift_go_into_the_layer_behind():
    (layer,) = fold(block_by_hand()).layers
    np.testing.assert_array_equal(layer.weight, np.diag([2, 4, 6, 8]))
    np.testing.assert_array_equal(layer.bias, [120, 140, 160, 180])


def test_eight_bits_are_for_weights_alone():
    graph = fold(graph_of(make("SAC", policy="SparseSimbaPolicy"), None))
    rounded = quantized(graph)
    for one, other in zip(graph.nodes, rounded.nodes, strict=True):
        assert (one is other) != isinstance(one, Linear)


def test_a_norm_keeps_the_constant_units_that_it_mixes_with_others():
    first = linear(0, [[0], [1]], [5, 0])
    norm = Standardize((1,), (2,), 0.0)
    graph = Graph((1,), (first, norm, linear(2, [[0, 1]])), (1,))
    small = remove_dead_units(graph)
    assert len(small.layers[0].bias) == 2
    # Of 5 and x the standardised x is 1 above 5 and -1 below
    np.testing.assert_allclose(small.run([[3.0], [9.0]]), [[-1], [1]])


def test_dead_units_within_a_block_vanish_and_its_ends_stay():
    first = linear(0, [[0], [1]], [5, 0])
    norm = Standardize((1,), (2,), 0.0)
    # relu(2) = 2 of unit 0, which reads nothing; nobody reads unit 2
    inner = linear(2, [[0, 0], [0, 3], [1, 1]], [2, 0, 0])
    outer = linear(4, [[7, 1, 0], [0, 0, 0]], [10, 0])
    graph = Graph((1,), (first, norm, inner, relu(3, 3), outer, Add((1, 5), (2,))), (2,))
    small = remove_dead_units(graph)
    assert [layer.weight.shape for layer in small.layers] == [(2, 1), (1, 2), (2, 1)]
    np.testing.assert_array_equal(small.layers[2].bias, [10 + 7 * 2, 0])
    np.testing.assert_allclose(small.run([[9.0]]), [[5 + 24 + 3, 9]])


def test_blocks_take_six_times_their_width_however_many_there_are(tmp_path):
    # What a block adds to, its norm and its four times as many hidden units; or those and its end
    for blocks in (1, 2, 3):
        kwargs = dict(sparsity=0.0, net_arch=[16] * blocks)
        model = make("DQN", policy="SparseSimbaPolicy", policy_kwargs=kwargs)
        report = export_policy(model, tmp_path / "policy", "c")
        assert report.sizes["RAM"] == 4 * 6 * 16


def test_a_sum_is_not_written_over_what_is_read_later():
    first, second = linear(0, [[1], [2]]), linear(0, [[3], [4]])
    total = Add((1, 2), (2,))  # over the second, since the first is read again
    graph = Graph((1,), (first, second, total, Add((3, 1), (2,)), linear(4, [[1, 1]])), (1,))
    places = plan_memory(graph).places
    assert places[2] == places[3] == places[4] != places[1]
    check_memory(graph)
    seen = np.float32([[10]])
    expected = [[(10 + 30 + 10) + (20 + 40 + 20)]]
    np.testing.assert_array_equal(compiled(write_c(graph, "0").source, graph)(seen), expected)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 25))
def test_no_value_is_overwritten_while_it_is_needed(seed, count):
    random = np.random.default_rng(seed)
    nodes = [linear(0, random.normal(size=(3, 2)))]
    for _ in range(count):
        one, other = random.integers(1, len(nodes) + 1, 2).tolist()
        kinds = (
            linear(one, random.normal(size=(3, 3))),
            relu(one, 3),
            Standardize((one,), (3,), 0.1),
            Add((one, other), (3,)),
        )
        nodes.append(kinds[random.integers(len(kinds))])
    check_memory(Graph((2,), tuple(nodes), (3,)))


def test_observations_are_normalised_as_by_vecnormalize(tmp_path):
    envs = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), clip_obs=np.inf)
    model = make("SAC", envs, policy="SparseSimbaPolicy")
    model.learn(60)
    envs.obs_rms.mean += 1000.0  # far from what the network expects as it is
    for to in GRAPH_ARTIFACTS:
        assert export_policy(model, tmp_path / to, to).parity.holds


@pytest.mark.parametrize("algorithm", ["SAC", "DQN", "PPO"])
def test_stock_sb3_has_no_such_networks(algorithm, tmp_path):
    model = make(algorithm, policy="SparseSimbaPolicy")
    with pytest.raises(UnsupportedError, match="SimBa networks, which stock SB3 does not have"):
        export_policy(model, tmp_path / "dense", "dense")
    assert not list(tmp_path.iterdir())
