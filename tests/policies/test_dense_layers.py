"""Layers left dense, by word and by pattern."""

from __future__ import annotations

import gymnasium as gym
import pytest
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import FlattenExtractor
from support import make
from torch import nn

from sb3_sparse import SparseDQNPolicy, SparsityCallback
from sb3_sparse.errors import ConfigError, UnsupportedError

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
    return {name for network in model.policy.sparse.networks for name, _ in network.dense_layers}


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
    with pytest.raises(ConfigError, match=r"'actor.nu', which matches no layer.*actor.mu.*'input'"):
        make("SAC", policy_kwargs=dict(dense_layers=["actor.nu"]))


def test_leaving_a_whole_network_dense_is_refused():
    with pytest.raises(ConfigError, match="nothing to make sparse in 'actor'"):
        make("SAC", policy_kwargs=dict(dense_layers=["actor"]))


def test_weight_decay_reaches_dense_layers_too_and_no_bias():
    plain, decayed = (
        make("DQN", policy_kwargs=dict(dense_layers=["output"], weight_decay=weight_decay))
        for weight_decay in (0.0, 0.5)
    )
    for model in (plain, decayed):
        optimizer = model.policy.optimizer = th.optim.SGD(model.q_net.parameters(), lr=1.0)
        model.policy.sparse.attach()
        for parameter in model.q_net.parameters():
            parameter.grad = th.zeros_like(parameter)
        optimizer.step()
    ours = dict(decayed.q_net.named_parameters())
    for name, parameter in plain.q_net.named_parameters():
        factor = 0.5 if name.endswith("weight") else 1.0
        assert th.equal(ours[name], factor * parameter), name


def test_a_frozen_layer_stays_dense_and_outside_the_budget():
    class Frozen(FlattenExtractor):
        def __init__(self, space):
            super().__init__(space)
            self.encoder = nn.Linear(4, 4).requires_grad_(False)

        def forward(self, observations):
            return self.encoder(super().forward(observations))

    model = make("DQN", policy_kwargs=dict(features_extractor_class=Frozen))
    assert dense_names(model) == {"q_net.features_extractor.encoder"}
    model.learn(60, callback=SparsityCallback("rigl", update_interval=5))


def test_a_weight_that_is_computed_is_refused():
    class Spectral(FlattenExtractor):
        def __init__(self, space):
            super().__init__(space)
            self.encoder = nn.utils.spectral_norm(nn.Linear(4, 4))

    with pytest.raises(UnsupportedError, match=r"encoder is computed.*use a plain Linear"):
        make("DQN", policy_kwargs=dict(features_extractor_class=Spectral))


def test_a_layer_that_no_network_has_is_refused_rather_than_left_dense_unnoticed():
    class Aside(SparseDQNPolicy):
        def _build(self, lr_schedule):
            super()._build(lr_schedule)
            self.aside = nn.Linear(4, 4)

    with pytest.raises(UnsupportedError, match=r"aside belongs to none of .*'q_net'.*`networks`"):
        DQN(Aside, "CartPole-v1", policy_kwargs=dict(sparsity=0.9))
