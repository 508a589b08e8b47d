"""The report, against numbers worked out by hand."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from support import make
from torch import nn


class Frames(gym.Env):
    """Atari-sized frames, channels first."""

    observation_space = spaces.Box(0, 255, (4, 84, 84), np.uint8)
    action_space = spaces.Discrete(6)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def test_flops_of_the_nature_cnn_by_hand():
    model = make("DQN", Frames(), policy_kwargs=dict(sparsity=0.0, net_arch=[]))
    rows = {row.name.split("q_net.")[-1]: row for row in model.policy.sparsity_report().layers}
    # positions * (2 * kernel + biases + activations), without padding: 20x20, 9x9, 7x7 positions.
    by_hand = {
        "features_extractor.cnn.0": 400 * (2 * 8 * 8 * 4 * 32 + 32 + 32),
        "features_extractor.cnn.2": 81 * (2 * 4 * 4 * 32 * 64 + 64 + 64),
        "features_extractor.cnn.4": 49 * (2 * 3 * 3 * 64 * 64 + 64 + 64),
        "features_extractor.linear.0": 2 * 3136 * 512 + 512 + 512,
        "0": 2 * 512 * 6 + 6,  # no activation behind the output
    }
    assert {name: row.flops for name, row in rows.items()} == by_hand
    parameters = (8192 + 32) + (32768 + 64) + (36864 + 64) + (3136 * 512 + 512) + (512 * 6 + 6)
    assert model.policy.sparsity_report().parameters == parameters


def test_sparse_flops_are_those_of_the_active_connections_at_every_position():
    model = make("DQN", Frames(), policy_kwargs=dict(sparsity=0.9, net_arch=[]))
    first, *_ = model.policy.sparsity_report().layers
    active = int((model.policy.state_dict()[f"{first.name}.weight"] != 0).sum())
    assert first.nnz == active
    assert first.flops == 400 * (2 * active + 64)
    assert first.dense_flops == 400 * (2 * 8192 + 64)


def test_the_table_names_every_layer_and_the_totals():
    model = make("SAC", policy_kwargs=dict(sparsity=0.5, dense_layers=["actor.mu"]))
    report = model.policy.sparsity_report()
    table = str(report)
    for row in report.layers:
        assert row.name in table
    assert "actor.mu           1x24" in table.replace("  actor", "actor")
    # Actor 3-24-24-(1+1) without mu: 72 + 576 + 24; critics 2 (4-24-24-1): 2 (96 + 576 + 24).
    size = 672 + 2 * 696
    nnz = sum(row.nnz for row in report.layers if row.in_budget)
    assert report.sparsity() == pytest.approx(1 - nnz / size)
    assert abs(nnz - size / 2) <= 2 * len(report.layers)
    biases = 24 + 24 + 1 + 1 + 2 * (24 + 24 + 1)
    assert report.parameters == nnz + 24 + biases
    assert f"parameters: {report.parameters:,}" in table


@pytest.mark.parametrize(
    ("compute", "inner", "full"),
    [
        ("auto", "sparse", "dense"),
        ("sparse",) + 2 * ("sparse",),
        ("masked", "masked", "dense"),
    ],
)
def test_every_row_says_how_the_layer_computes(compute, inner, full):
    kwargs = dict(net_arch=[200, 200], compute=compute, dense_layers=["actor.latent_pi.0"])
    report = make("SAC", policy_kwargs=kwargs).policy.sparsity_report()
    rows = {row.name: row for row in report.layers}
    assert (
        rows["actor.latent_pi.0"].compute == "dense"
    )  # no sparse layer, so never in sparse storage
    assert rows["actor.latent_pi.2"].compute == rows["critic.qf1.2"].compute == inner
    assert rows["actor.mu"].density == 1.0  # within the budget, which gives it all 200
    assert rows["actor.mu"].compute == full
    lines = {line.split()[0]: line.split()[-1] for line in str(report).splitlines() if line}
    assert lines["layer"] == "compute"
    assert {name: lines[name] for name in rows} == {n: row.compute for n, row in rows.items()}


def test_a_policy_without_zeros_is_dense():
    report = make("PPO", policy_kwargs=dict(sparsity=0.0)).policy.sparsity_report()
    assert {row.compute for row in report.layers} == {"dense"}


def test_a_report_leaves_the_policy_as_it_was():
    model = make("DQN", gym.make("TinyImages-v0"))
    model.policy.set_training_mode(True)
    modes = [module.training for module in model.policy.modules()]
    model.policy.sparsity_report()
    assert [module.training for module in model.policy.modules()] == modes
    assert not any(module._forward_hooks for module in model.policy.modules())


class Embedded(BaseFeaturesExtractor):
    """An embedding, attention and a matrix of its own beside a linear layer."""

    def __init__(self, space):
        super().__init__(space, 8)
        self.words = nn.Embedding(5, 6)
        self.first = nn.Linear(space.shape[0], 8)
        self.mixing = nn.Parameter(th.eye(8))

    def forward(self, x):
        words = self.words((x[:, :1].abs() * 4).long().clamp(0, 4)).mean(dim=(1, 2))
        return (self.first(x) + words[:, None]) @ self.mixing


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_matrices_that_are_no_layers_are_listed_as_dense(name):
    model = make(name, policy_kwargs=dict(features_extractor_class=Embedded))
    report = model.policy.sparsity_report()
    others = {r.name.split(".")[-2] + "." + r.name.split(".")[-1]: r for r in report.layers
              if not r.in_budget}  # fmt: skip
    assert others["words.weight"].shape == (5, 6)
    assert others["words.weight"].nnz == others["words.weight"].parameters == 30
    assert others["features_extractor.mixing"].nnz == 64
    assert not any("target" in r.name for r in report.layers)
    assert "words.weight" in str(report)
    assert abs(report.sparsity() - 0.9) < 0.01
