"""Image networks: counted by hand, sparse through the same engine, saved and loaded."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.torch_layers import NatureCNN
from support import assert_masked, make

from sb3_sparse import SparsityCallback
from sb3_sparse.errors import ConfigError
from sb3_sparse.networks import ImpalaCNN, ScaledNatureCNN

FRAMES = spaces.Box(0, 255, (4, 84, 84), np.uint8)
IMPALA = "sb3_sparse.networks.ImpalaCNN"


def parameters(module):
    return sum(p.numel() for p in module.parameters())


def test_impala_has_the_parameters_of_a_hand_count():
    # kernels: 3x3 convolutions 4->32 and four 32->32; 32->64 and four 64->64; five 64->64;
    # 84 -> 42 -> 21 -> 11 after three pools, so 11*11*64 = 7744 features into 512
    convolutions = 1152 + 4 * 9216 + 18432 + 4 * 36864 + 5 * 36864
    biases = 5 * 32 + 5 * 64 + 5 * 64
    dense = 7744 * 512 + 512
    assert parameters(ImpalaCNN(FRAMES)) == convolutions + biases + dense == 4_354_464


def test_nature_has_the_parameters_of_a_hand_count():
    convolutions = 8 * 8 * 4 * 32 + 4 * 4 * 32 * 64 + 3 * 3 * 64 * 64
    biases = 32 + 64 + 64 + 512
    assert parameters(NatureCNN(FRAMES)) == convolutions + biases + 7 * 7 * 64 * 512 == 1_684_128


def test_impala_is_three_stacks_of_a_convolution_a_pool_and_two_residual_blocks():
    network = ImpalaCNN(FRAMES)
    kinds = [type(module).__name__ for module in network.cnn]
    one = ["Conv2d", "MaxPool2d", "ResidualBlock", "ResidualBlock"]
    assert kinds == [*one, *one, *one, "ReLU", "Flatten"]
    assert not any("Norm" in type(module).__name__ for module in network.modules())


def test_a_residual_block_adds_its_input():
    block = ImpalaCNN(FRAMES).cnn[2]
    for p in block.parameters():
        p.data.zero_()
    x = th.randn(2, 32, 5, 5)
    assert th.equal(block(x), x)


def test_features_have_the_shape_that_is_asked_for():
    network = ImpalaCNN(FRAMES, channels=(2, 3, 4), features_dim=7)
    assert network(th.rand(5, 4, 84, 84)).shape == (5, 7)
    assert network.features_dim == 7


def test_scaled_nature_is_natures_at_its_own_width_and_smaller_below():
    th.manual_seed(0)
    ours = ScaledNatureCNN(FRAMES)
    th.manual_seed(0)
    theirs = NatureCNN(FRAMES)
    x = th.rand(2, 4, 84, 84)
    assert th.equal(ours(x), theirs(x))
    small = ScaledNatureCNN(FRAMES, channels=(3, 5, 7), features_dim=11)
    count = (256 + 1) * 3 + (16 * 3 + 1) * 5 + (9 * 5 + 1) * 7 + (49 * 7 + 1) * 11
    assert parameters(small) == count
    assert small(x).shape == (2, 11)


@pytest.mark.parametrize("network", [ImpalaCNN, ScaledNatureCNN])
@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (spaces.Box(-1, 1, (4,), np.float32), {}, "takes images"),
        (spaces.Discrete(3), {}, "takes images"),
        (FRAMES, {"channels": (1, 2)}, "three whole numbers"),
        (FRAMES, {"channels": (1, 2, 0)}, "three whole numbers"),
    ],
)
def test_what_does_not_fit_is_rejected(network, space, kwargs, message):
    with pytest.raises(ConfigError, match=message):
        network(space, **kwargs)


@pytest.mark.parametrize("algorithm", ["DQN", "PPO"])
@pytest.mark.parametrize("extractor", [IMPALA, "sb3_sparse.networks.ScaledNatureCNN"])
def test_both_networks_train_sparsely_and_come_back(algorithm, extractor, tmp_path):
    kwargs = dict(
        net_arch=[],
        sparsity=0.8,
        features_extractor_class=extractor,
        features_extractor_kwargs=dict(channels=[4, 4, 4], features_dim=16),
    )
    model = make(algorithm, "TinyImages-v0", policy_kwargs=kwargs)
    before = {layer.name: layer.mask().copy() for layer in model.policy.sparse.layers}
    model.learn(80, callback=SparsityCallback("rigl", update_interval=4))
    assert_masked(model)
    layers = list(model.policy.sparse.layers)
    assert sum(len(layer.shape) == 4 for layer in layers) >= 3
    assert any((layer.mask() != before[layer.name]).any() for layer in layers)
    model.save(tmp_path / "model")
    cls = {"DQN": DQN, "PPO": PPO}[algorithm]
    again = cls.load(tmp_path / "model")
    observation = model.get_env().reset()
    predicted = [m.predict(observation, deterministic=True)[0] for m in (model, again)]
    assert (predicted[0] == predicted[1]).all()
    network = again.q_net if algorithm == "DQN" else again.policy
    assert type(network.features_extractor).__name__ in extractor


def test_the_impala_of_the_paper_has_its_sparsity_in_dqn():
    model = make(
        "DQN",
        "TinyImages-v0",
        policy_kwargs=dict(net_arch=[], sparsity=0.9, features_extractor_class=IMPALA),
    )
    report = model.policy.sparsity_report()
    assert abs(report.sparsity() - 0.9) < 1e-4
    assert len(report.layers) == 15 + 1 + 1  # convolutions, dense layer, head
