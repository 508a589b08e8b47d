"""Layers left dense, by word and by pattern."""

from __future__ import annotations

import gymnasium as gym
import pytest
from support import make

from sb3_sparse.errors import ConfigError

INPUTS = {
    "DQN": {"q_net.q_net.0"},
    "SAC": {"actor.latent_pi.0", "critic.qf0.0", "critic.qf1.0"},
    "TD3": {"actor.mu.0", "critic.qf0.0", "critic.qf1.0"},
    "PPO": {"mlp_extractor.policy_net.0", "mlp_extractor.value_net.0"},
    "QRDQN": {"quantile_net.quantile_net.0"},
    "CrossQ": {"actor.latent_pi.1", "critic.qf0.1", "critic.qf1.1"},
}
OUTPUTS = {
    "DQN": {"q_net.q_net.4"},
    "SAC": {"actor.mu", "actor.log_std", "critic.qf0.4", "critic.qf1.4"},
    "TD3": {"actor.mu.4", "critic.qf0.4", "critic.qf1.4"},
    "PPO": {"action_net", "value_net"},
    "QRDQN": {"quantile_net.quantile_net.4"},
    "CrossQ": {"actor.mu", "actor.log_std", "critic.qf0.7", "critic.qf1.7"},
}


def dense_names(model) -> set[str]:
    return {name for network in model.policy.sparse.networks for name, _ in network.dense_kernels}


@pytest.mark.parametrize("name", sorted(INPUTS))
def test_the_words_input_and_output(name):
    assert dense_names(make(name, policy_kwargs=dict(dense_layers=["input"]))) == INPUTS[name]
    assert dense_names(make(name, policy_kwargs=dict(dense_layers=["output"]))) == OUTPUTS[name]


def test_output_of_gsde_is_the_layer_inside_its_clip():
    model = make("SAC", use_sde=True, policy_kwargs=dict(dense_layers=["output"]))
    assert "actor.mu.0" in dense_names(model)


def test_images_are_read_by_the_first_convolution():
    kwargs = dict(features_extractor_kwargs=dict(features_dim=16), dense_layers=["input"])
    model = make("DQN", gym.make("TinyImages-v0"), policy_kwargs=kwargs)
    assert dense_names(model) == {"q_net.features_extractor.cnn.0"}


def test_dicts_are_read_by_the_convolution_and_by_the_first_layer_behind_it():
    kwargs = dict(features_extractor_kwargs=dict(cnn_output_dim=16), dense_layers=["input"])
    model = make("DQN", gym.make("TinyDicts-v0"), policy_kwargs=kwargs)
    assert dense_names(model) == {
        "q_net.features_extractor.extractors.image.cnn.0",
        "q_net.q_net.0",
    }


def test_without_hidden_layers_the_heads_read_the_observation():
    kwargs = dict(net_arch=dict(pi=[], qf=[8]), dense_layers=["input"])
    with pytest.raises(ConfigError, match="nothing to make sparse in 'actor'"):
        make("SAC", policy_kwargs=kwargs)


def test_patterns_and_whole_modules():
    model = make("SAC", policy_kwargs=dict(dense_layers=["actor.mu", "critic.qf*.4"]))
    assert dense_names(model) == {"actor.mu", "critic.qf0.4", "critic.qf1.4"}
    model = make("SAC", policy_kwargs=dict(dense_layers=["critic.qf0"]))
    assert dense_names(model) == {"critic.qf0.0", "critic.qf0.2", "critic.qf0.4"}


def test_dense_layers_are_outside_the_budget_and_have_no_mask():
    model = make("DQN", policy_kwargs=dict(dense_layers=["output"]))
    (network,) = model.policy.sparse.networks
    assert network.size == 4 * 24 + 24 * 24
    assert abs(network.nnz - 0.1 * network.size) <= 2 * len(network.layers)
    assert "q_net.q_net.4.weight_mask" not in model.policy.state_dict()
    assert "q_net.q_net.2.weight_mask" in model.policy.state_dict()


def test_a_pattern_that_matches_nothing_lists_the_layers():
    with pytest.raises(ConfigError, match=r"'actor.nu', which is no layer.*actor.mu.*'input'"):
        make("SAC", policy_kwargs=dict(dense_layers=["actor.nu"]))


def test_leaving_a_whole_network_dense_is_refused():
    with pytest.raises(ConfigError, match="nothing to make sparse in 'actor'"):
        make("SAC", policy_kwargs=dict(dense_layers=["actor"]))


def test_weight_decay_reaches_dense_kernels_too_and_no_bias():
    model = make("DQN", policy_kwargs=dict(dense_layers=["output"], weight_decay=1e-3))
    groups = model.policy.optimizer.param_groups
    decayed = {id(p) for g in groups if g["weight_decay"] == 1e-3 for p in g["params"]}
    named = dict(model.policy.q_net.named_parameters())
    assert decayed == {id(p) for name, p in named.items() if name.endswith("weight")}
    others = {id(p) for g in groups if g["weight_decay"] == 0 for p in g["params"]}
    assert others == {id(p) for name, p in named.items() if name.endswith("bias")}
