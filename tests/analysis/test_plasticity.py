"""Dormant units, effective ranks and the history of masks, by hand."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch as th
from support import make

from sb3_sparse import SparsityCallback
from sb3_sparse.analysis import (
    PlasticityCallback,
    dormant_share,
    effective_rank,
    effective_ranks,
)
from sb3_sparse.analysis.activity import activity
from sb3_sparse.analysis.maskhistory import MaskHistory
from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.topology import Exchange


def q_net_by_hand(rows):
    """A Q network whose one hidden layer has these weights and no biases."""
    model = make("DQN", policy="MlpPolicy", policy_kwargs={"net_arch": [len(rows)]})
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.zero_()
        model.policy.q_net.q_net[0].weight.copy_(th.tensor(rows))
    return model


UNITS = [[4.0, 0, 0, 0], [0, 1.0, 0, 0], [-1.0, 0, 0, 0], [0, 0, 0.08, 0]]


def test_dormant_units_by_hand():
    model = q_net_by_hand(UNITS)
    observations = np.array([[1, 2, 1, 0], [1, 0, 1, 0]], np.float32)
    # Mean activations 4, 1, 0 and 0.08; the layer's mean is 1.27, and 0.08 / 1.27 = 0.063
    assert dormant_share(model, observations).overall == 0.25
    assert dormant_share(model, observations, tau=0.07).networks == {"q_net": 0.5}
    assert dormant_share(model.policy, observations, tau=0.0).overall == 0.25
    assert dormant_share(model, np.zeros((3, 4), np.float32)).overall == 1.0


def test_features_of_the_output_layer_by_hand():
    model = q_net_by_hand(UNITS)
    observations = np.array([[1, 2, 1, 0], [1, 0, 1, 0]], np.float32)
    (features,) = activity(model, observations)["q_net"].features
    np.testing.assert_allclose(features, [[4, 2, 0, 0.08], [4, 0, 0, 0.08]], rtol=1e-6)
    assert effective_ranks(model, observations) == {"q_net": 2.0}


def test_effective_rank_by_hand():
    assert effective_rank(np.diag([90.0, 9.0, 1.0])) == 2  # 99 of 100
    assert effective_rank(np.diag([90.0, 8.9, 1.1])) == 3
    assert effective_rank(np.diag([90.0, 9.0, 1.0]), delta=0.1) == 1
    assert effective_rank(np.outer([1, 2, 3], [4, 5])) == 1
    assert effective_rank(np.zeros((3, 2))) == 0
    with pytest.raises(ConfigError, match="shape"):
        effective_rank(np.zeros(3))


def test_many_observations_are_run_in_parts():
    model = make("SAC")
    observations = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    whole = activity(model, observations)
    parts = [activity(model, observations[i : i + 100]) for i in (0, 100, 200)]
    for network in ("actor", "critic"):
        for i, units in enumerate(whole[network].activations):
            mean = np.mean([part[network].activations[i] for part in parts], axis=0)
            np.testing.assert_allclose(units, mean, rtol=1e-5, atol=1e-7)
    assert [len(whole[n].features) for n in ("actor", "critic")] == [1, 2]  # heads, twins


@pytest.mark.parametrize("policy", ["SparsePolicy", "SparseSimbaPolicy"])
@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_sparse_networks_show_what_masked_ones_do(compute, policy):
    model = make("SAC", policy=policy, policy_kwargs={"compute": compute})
    observations = np.linspace(-1, 1, 60, dtype=np.float32).reshape(20, 3)
    (features,) = activity(model, observations)["actor"].features
    with th.no_grad():
        latent = model.actor.latent_pi(th.from_numpy(observations))
    np.testing.assert_allclose(features, latent.numpy(), rtol=1e-5, atol=1e-6)


def test_units_of_simba_networks_are_those_within_the_blocks():
    kwargs = {"sparsity": 0.0, "net_arch": [3, 3]}
    model = make("DQN", policy="SparseSimbaPolicy", policy_kwargs=kwargs)
    second = model.policy.q_net.q_net[2].residual[1]
    with th.no_grad():
        second.weight.zero_()
        second.bias.copy_(th.tensor([-1.0] * 9 + [1.0] * 3))
    first, last = activity(model, np.ones((2, 4), np.float32))["q_net"].activations
    assert first.shape == (12,)
    np.testing.assert_array_equal(last, [0] * 9 + [1] * 3)


@pytest.mark.parametrize("name", ["TD3", "A2C", "QRDQN", "TQC", "CrossQ"])
def test_other_algorithms_work_and_images_have_channels_as_units(name):
    model = make(name)
    model.learn(40, callback=PlasticityCallback(10))
    found = []
    for compute in ("masked", "sparse"):
        kwargs = {"net_arch": [], "compute": compute}
        images = make("DQN", "TinyImages-v0", policy_kwargs=kwargs)
        shape = (2, *images.observation_space.shape)
        found.append(activity(images, np.ones(shape, np.uint8))["q_net"].activations)
    assert [len(layer) for layer in found[0]] == [32, 64, 64, 512]
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_what_has_no_units_says_so():
    model = make("DQN", policy_kwargs={"net_arch": []})
    with pytest.raises(ConfigError, match="no units"):
        dormant_share(model, np.ones((2, 4), np.float32))
    assert effective_ranks(model, np.ones((2, 4), np.float32)) == {"q_net": 1.0}


def move(layer, count=1):
    """Drop the first active connections and grow the first inactive ones."""
    mask = layer.mask()
    dropped, grown = np.flatnonzero(mask)[:count], np.flatnonzero(~mask)[:count]
    layer.move(Exchange(dropped, grown))


def network_of(name="DQN"):
    model = make(name, policy_kwargs={"distribution": "uniform", "net_arch": [10]})
    (network,) = model.policy.sparse.networks
    return network  # 40 and 20 connections, 4 and 2 of them active


def test_churn_and_exploration_by_hand(tmp_path):
    network = network_of()
    history = MaskHistory([network], 0, tmp_path / "masks.npz")
    assert history.look(10) == {"q_net": (0.0, 0.1)}
    move(network.layers[0], 3)
    assert history.look(20) == {"q_net": (6 / 60, 9 / 60)}
    move(network.layers[1])
    move(network.layers[1])  # what was grown goes again, and one more is explored unseen
    explored = history.look(30)["q_net"][1]
    assert 9 / 60 < explored <= 11 / 60
    assert history.look(40) == {"q_net": (0.0, explored)}


def test_a_history_goes_on_where_the_model_does(tmp_path):
    path = tmp_path / "masks.npz"
    network = network_of()
    history = MaskHistory([network], 0, path)
    move(network.layers[0], 2)
    history.look(10)
    move(network.layers[0], 1)
    assert MaskHistory([network], 15, path).look(20) == history.look(20)
    saved, explored = network.layers[0].mask(), history.look(25)["q_net"][1]
    move(network.layers[0], 4)
    assert history.look(30)["q_net"][1] > explored
    network.layers[0].set_mask(saved)  # killed, and gone on from 25: the file is ahead
    assert MaskHistory([network], 25, path).look(30) == {"q_net": (0.0, explored)}
    with pytest.warns(UserWarning, match="count from step 5"):
        MaskHistory([network], 5, tmp_path / "absent.npz")
    other = make("DQN").policy.sparse.networks
    with pytest.raises(CorruptStateError, match="other layers"):
        MaskHistory(other, 30, path)


def test_the_callback_writes_all_measures_and_resumes(tmp_path):
    path = tmp_path / "plasticity.csv"
    model = make("SAC")
    callbacks = [SparsityCallback("set", update_interval=10), PlasticityCallback(25, path)]
    model.learn(100, callback=callbacks)
    model.learn(50, callback=PlasticityCallback(25, path), reset_num_timesteps=False)
    with path.open() as file:
        rows = [(int(r["timesteps"]), r["name"], float(r["value"])) for r in csv.DictReader(file)]
    names = {name for _, name, _ in rows}
    kinds = ("dormant", "effective_rank", "mask_churn", "exploration")
    assert names == {"plasticity/dormant"} | {
        f"plasticity/{kind}/{network}" for kind in kinds for network in ("actor", "critic")
    }
    explored = [v for t, name, v in rows if name == "plasticity/exploration/critic"]
    assert len(explored) == 6
    assert 0.1 < explored[0] < explored[3] == explored[4] == explored[5]
    assert (tmp_path / "plasticity.masks.npz").exists()
    stock = make("DQN", policy="MlpPolicy")
    stock.learn(60, callback=PlasticityCallback(25, path))
    assert "exploration" not in path.read_text()
