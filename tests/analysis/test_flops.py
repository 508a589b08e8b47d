"""FLOPs against torch's counter, hand numbers and the paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from algorithms_support import NAMES
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from stable_baselines3.dqn.policies import DQNPolicy
from support import make
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

import sb3_sparse
from sb3_sparse.analysis import flops
from sb3_sparse.errors import ConfigError, UnsupportedError
from sb3_sparse.networks import ImpalaCNN
from sb3_sparse.policies.dqn import SparseDQNPolicy

FRAMES = spaces.Box(0, 255, (4, 84, 84), np.uint8)


def q_policy(extractor, cls=DQNPolicy, **kwargs):
    return cls(
        FRAMES,
        spaces.Discrete(6),
        lambda _: 1e-4,
        net_arch=[],
        features_extractor_class=extractor,
        **kwargs,
    )


def counted_by_torch(policy) -> int:
    observation = preprocess_obs(th.zeros(1, *FRAMES.shape), FRAMES)
    with th.no_grad(), FlopCounterMode(display=False) as counter:
        policy.q_net.q_net(policy.q_net.features_extractor(observation))
    return counter.get_total_flops()


def test_the_dense_nature_cnn_is_what_torch_counts_and_biases_and_activations():
    policy = q_policy(NatureCNN)
    # 20x20 places of 32 channels, 9x9 of 64, 7x7 of 64, 512 units: a bias and an activation each
    rest = 2 * (400 * 32 + 81 * 64 + 49 * 64 + 512) + 6
    report = flops(policy)
    assert report.forward() == report.dense_forward() == counted_by_torch(policy) + rest
    assert report.networks == ("q_net",)


def test_the_dense_impala_resnet_is_what_torch_counts_and_biases_and_activations():
    policy = q_policy(ImpalaCNN)
    # Of every stack: a convolution, and four in residual blocks of which two have a ReLU behind
    places = [(84 * 84, 42 * 42, 32), (42 * 42, 21 * 21, 64), (21 * 21, 11 * 11, 64)]
    biases = sum((before + 4 * after) * channels for before, after, channels in places)
    activations = sum(2 * after * channels for _, after, channels in places)
    rest = biases + activations + 2 * 512 + 6
    assert flops(policy).forward() == counted_by_torch(policy) + rest


def test_stock_and_sparse_policies_have_the_same_dense_count():
    for name in ("DQN", "SAC", "PPO", "TD3"):
        stock, sparse = flops(make(name, policy="MlpPolicy")), flops(make(name))
        assert stock.dense_forward() == sparse.dense_forward() == stock.forward()
        assert stock.dense_step() == sparse.dense_step() == stock.step()
        assert sparse.step() < 0.5 * stock.step()


def test_a_sparse_count_by_hand():
    model = make("DQN", policy_kwargs={"net_arch": [10, 10], "distribution": "uniform"})
    # CartPole: 4 -> 10 -> 10 -> 2; a tenth of 40, 100 and 20 connections
    report = flops(model.policy)
    assert [layer.nnz for layer in report.layers] == [4, 10, 2]
    assert [layer.forward for layer in report.layers] == [8 + 20, 20 + 20, 4 + 2]
    assert report.forward("q_net") == 74
    assert report.dense_forward() == (80 + 20) + (200 + 20) + (40 + 2)


def test_a_simba_network_by_hand():
    kwargs = {"net_arch": [10], "distribution": "uniform"}
    model = make("DQN", policy="SparseSimbaPolicy", policy_kwargs=kwargs)
    # CartPole: 4 -> 10, 10 -> 40 -> 10, 10 -> 2; a tenth of 40, 400, 400 and 20 connections
    report = flops(model)
    assert [layer.nnz for layer in report.layers] == [4, 40, 40, 2]
    # Behind the first a norm; behind the others a ReLU, the sum of the block and the last norm
    norm = 10 * (5 + 2)
    assert [layer.forward for layer in report.layers] == [
        8 + 10 + norm,
        80 + 40 + 40,
        80 + 10 + 10 + norm,
        4 + 2,
    ]
    dense = 2 * (40 + 400 + 400 + 20) + (10 + 40 + 10 + 2) + 40 + 10 + 2 * norm
    assert report.dense_forward() == dense
    assert report.step() == model.batch_size * 4 * report.forward()


@pytest.mark.parametrize(("affine", "bias", "each"), [(0, 0, 5), (1, 0, 6), (1, 1, 7)])
def test_norms_of_ones_own_count_as_well(affine, bias, each):
    class Own(BaseFeaturesExtractor):
        def __init__(self, space):
            super().__init__(space, 6)
            norm = nn.LayerNorm(6, elementwise_affine=bool(affine), bias=bool(bias))
            self.layers = nn.Sequential(nn.Linear(4, 6), norm, nn.Tanh(), nn.Linear(6, 6))

        def forward(self, x):
            return self.layers(x)

    kwargs = {"net_arch": [], "features_extractor_class": Own}
    first, second, _ = flops(make("DQN", policy="MlpPolicy", policy_kwargs=kwargs).policy).layers
    assert first.forward == 2 * 24 + 6 + 6 * each + 6
    assert second.forward == 2 * 36 + 6


def test_gradient_steps_by_hand():
    dqn = flops(make("DQN", policy="MlpPolicy"), batch_size=3)
    assert dqn.step() == 3 * 4 * dqn.forward()  # forward, backward, target
    sac = flops(make("SAC", policy="MlpPolicy"), batch_size=2)
    assert sac.step("actor") == 2 * (2 + 2) * sac.forward("actor")
    # own loss 3, of the actor's actions 1 and back through 1, target 1
    assert sac.step("critic") == 2 * 6 * sac.forward("critic")
    ppo = flops(make("PPO", policy="MlpPolicy"))
    assert ppo.batch_size == 16
    assert ppo.step() == 16 * 3 * ppo.forward()
    a2c = flops(make("A2C", policy="MlpPolicy"))
    assert a2c.step() == 8 * 3 * a2c.forward()
    td3 = flops(make("TD3", policy="MlpPolicy", policy_delay=4), batch_size=1)
    assert td3.step("actor") == (1 + 3 / 4) * td3.forward("actor")
    # own loss 3, target 1; of the actor's loss every fourth time forward and through, one of two
    assert td3.step("critic") == (3 + 1 + 2 / 4 / 2) * td3.forward("critic")


@pytest.mark.parametrize("name", NAMES)
def test_gradient_steps_of_our_algorithms_count_as_those_of_stock(name):
    ours = flops(make(getattr(sb3_sparse, name)))
    assert ours.step() == flops(make(name)).step() > 0


def test_shared_features_count_once_for_ppo_and_without_the_actions_gradient_for_sac():
    kwargs = {"features_extractor_kwargs": {"features_dim": 8}}
    ppo = flops(make("PPO", "TinyImages-v0", "CnnPolicy", kwargs), batch_size=1)
    assert ppo.step() == 3 * ppo.forward()
    shared = {**kwargs, "share_features_extractor": True}
    env = make_box_images()
    sac = flops(make("SAC", env, "CnnPolicy", shared), batch_size=1)
    (conv, *_) = sac.layers
    assert conv.network == "actor"
    # actor's two forward and one backward, critic's two forward, its target's one
    assert conv.step == (2 + 2 + 2 + 1) * conv.forward


def make_box_images():
    import gymnasium as gym

    return gym.make("TinyImages-v0", discrete=False)


@pytest.mark.parametrize(
    ("extractor", "low", "high"), [(NatureCNN, 1.5, 1.8), (ImpalaCNN, 2.4, 2.8)]
)
def test_erk_costs_more_than_uniform(extractor, low, high):
    erk, uniform = (
        flops(q_policy(extractor, SparseDQNPolicy, sparsity=0.9, distribution=d)).forward()
        for d in ("erk", "uniform")
    )
    assert low < erk / uniform < high


def test_what_cannot_be_counted_says_so():
    with pytest.raises(ConfigError, match="TRPO runs its networks"):
        flops(make("TRPO"))
    forward = flops(make("TRPO").policy)
    assert forward.forward() > 0
    with pytest.raises(ConfigError, match="call flops with the model"):
        forward.step()
    with pytest.raises(ConfigError, match="means nothing"):
        flops(make("DQN").policy, batch_size=3)

    class Another(DQN):
        def train(self, gradient_steps, batch_size=100):
            """Something else."""

    with pytest.raises(ConfigError, match="Another"):
        flops(make(Another, "CartPole-v1"))
    from sb3_contrib import RecurrentPPO

    recurrent = RecurrentPPO("MlpLstmPolicy", "CartPole-v1", n_steps=8, batch_size=8)
    with pytest.raises(UnsupportedError, match="LSTM"):
        flops(recurrent.policy)


def test_the_table_has_every_layer_and_the_totals():
    report = flops(make("SAC"))
    text = str(report)
    assert all(layer.name in text for layer in report.layers)
    assert f"{report.forward():,}" in text
    assert "gradient step of SAC at batch 16" in text
    assert math.isclose(report.step(), report.step("actor") + report.step("critic"))
