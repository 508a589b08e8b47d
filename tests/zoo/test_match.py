"""The dense network of equal parameter count, against counts made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC

from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.distributions import active_counts
from sb3_sparse.sparsity.widths import mlp_parameters
from sb3_sparse.zoo.match import match_parameters
from sb3_sparse.zoo.settings import Settings

VECTOR = spaces.Box(-1, 1, (17,), np.float32)
ACTIONS = spaces.Box(-1, 1, (6,), np.float32)
IMAGES = spaces.Box(0, 255, (4, 84, 84), np.uint8)


def settings(policy="SparsePolicy", **policy_kwargs):
    return Settings({"policy": policy, "policy_kwargs": {"sparsity": 0.0, **policy_kwargs}})


def best_width(count, target):
    """Of all widths, that with the nearest count."""
    return min(range(1, 300), key=lambda width: abs(count(width) - target))


def test_sac_scales_actor_and_both_critics():
    def dense(width):
        actor = mlp_parameters(17, [width, width], 12)
        critic = mlp_parameters(23, [width, width], 1)
        return actor + 2 * critic

    biases = (256 + 256 + 12) + 2 * (256 + 256 + 1)
    # mu and log_std are two layers of 6 x 256
    actor = sum(active_counts([(256, 17), (256, 256), (6, 256), (6, 256)], 0.9))
    critic = sum(active_counts([(256, 23), (256, 256), (1, 256)], 0.9))
    target = actor + 2 * critic + biases
    match = match_parameters(SAC, VECTOR, ACTIONS, settings(net_arch=[256, 256]), 0.9)
    width = best_width(dense, target)
    assert match.target == target
    assert match.achieved == dense(width)
    assert match.policy_kwargs["net_arch"] == [width, width]
    assert match.policy_kwargs["sparsity"] == 0.0


def simba_parameters(inputs, width, blocks, outputs):
    """Weights and biases of the linear layers; those of norms are not counted."""
    block = (width + 1) * 4 * width + (4 * width + 1) * width
    return (inputs + 1) * width + blocks * block + (width + 1) * outputs


def test_simba_keeps_one_width_in_each_network():
    def dense(pi, qf):
        return simba_parameters(17, pi, 1, 12) + 2 * simba_parameters(23, qf, 2, 1)

    arch = {"pi": [32], "qf": [64, 64]}
    match = match_parameters(
        SAC, VECTOR, ACTIONS, settings("SparseSimbaPolicy", net_arch=arch), 0.8
    )
    (pi,), (qf, other) = match.policy_kwargs["net_arch"].values()
    assert qf == other
    assert match.achieved == dense(pi, qf)
    assert abs(match.achieved - match.target) < 0.05 * match.target
    assert abs(qf - 2 * pi) <= 1
    layers = [(32, 17), (128, 32), (32, 128), (6, 32), (6, 32)]
    actor = sum(active_counts(layers, 0.8)) + (32 + 128 + 32 + 12)
    blocks = 2 * [(256, 64), (64, 256)]
    critic = sum(active_counts([(64, 23), *blocks, (1, 64)], 0.8)) + 64 + 2 * 320 + 1
    assert match.target == actor + 2 * critic


def test_ppo_scales_policy_and_value_network():
    arch = {"pi": [64, 64], "vf": [64, 64]}

    def dense(width):
        return mlp_parameters(4, [width, width], 2) + mlp_parameters(4, [width, width], 1)

    four = spaces.Box(-1, 1, (4,), np.float32)
    match = match_parameters(PPO, four, spaces.Discrete(2), settings(net_arch=arch), 0.8)
    width = best_width(dense, match.target)
    assert match.achieved == dense(width)
    assert match.policy_kwargs["net_arch"] == {"pi": [width] * 2, "vf": [width] * 2}
    assert arch == {"pi": [64, 64], "vf": [64, 64]}


def test_the_nature_cnn_scales_channels_and_dense_units():
    match = match_parameters(DQN, IMAGES, spaces.Discrete(6), settings(net_arch=[]), 0.9)
    first, second, third = match.policy_kwargs["features_extractor_kwargs"]["channels"]
    dense = match.policy_kwargs["features_extractor_kwargs"]["features_dim"]
    achieved = (
        (8 * 8 * 4 + 1) * first
        + (4 * 4 * first + 1) * second
        + (3 * 3 * second + 1) * third
        + (7 * 7 * third + 1) * dense
        + (dense + 1) * 6
    )
    assert match.achieved == achieved
    assert abs(achieved - match.target) < 0.05 * match.target
    assert second == third
    assert abs(second - 2 * first) <= 1


def test_impala_scales_channels_and_dense_units():
    given = settings(
        net_arch=[],
        features_extractor_class="sb3_sparse.networks.ImpalaCNN",
        features_extractor_kwargs={"channels": [32, 64, 64], "features_dim": 512},
    )
    match = match_parameters(DQN, IMAGES, spaces.Discrete(6), given, 0.9)
    extractor = match.policy_kwargs["features_extractor_kwargs"]
    inputs, count = 4, 0
    for channels in extractor["channels"]:
        count += (9 * inputs + 1) * channels + 4 * (9 * channels + 1) * channels
        inputs = channels
    dense = extractor["features_dim"]
    count += (11 * 11 * inputs + 1) * dense + (dense + 1) * 6
    assert match.achieved == count
    assert abs(count - match.target) < 0.05 * match.target


def test_unknown_widths_are_asked_for():
    with pytest.raises(ConfigError, match=r"net_arch:\[256,256\]"):
        match_parameters(SAC, VECTOR, ACTIONS, settings(), 0.9)


def test_a_match_says_what_was_built():
    dqn = match_parameters(DQN, VECTOR, spaces.Discrete(2), settings(net_arch=[64, 64]), 0.9)
    width, _ = dqn.policy_kwargs["net_arch"]
    parameters = 18 * width + (width + 1) * width + (width + 1) * 2
    assert str(dqn) == (
        f"Built a dense network of net_arch [{width}, {width}]: {parameters:,} parameters; at 0.9 "
        f"sparsity the full one has {dqn.target:,}"
    )
    images = match_parameters(DQN, IMAGES, spaces.Discrete(2), settings(net_arch=[]), 0.9)
    built = images.policy_kwargs["features_extractor_kwargs"]
    said = f"net_arch [], channels {built['channels']}, features_dim {built['features_dim']}: "
    assert said in str(images)
