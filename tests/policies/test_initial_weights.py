"""Masks and weights that training starts with."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from support import make


def masks_of(model) -> dict[str, np.ndarray]:
    return {layer.name: layer.mask() for layer in model.policy.sparse.layers}


def test_same_seed_same_masks_and_another_seed_others():
    first, second, third = (masks_of(make("SAC", seed=seed)) for seed in (3, 3, 4))
    assert all((first[name] == second[name]).all() for name in first)
    assert any((first[name] != third[name]).any() for name in first)


def test_models_without_a_seed_differ_as_those_of_sb3_do():
    one, two = (masks_of(make("SAC", seed=None)) for _ in range(2))
    assert any((one[name] != two[name]).any() for name in one)


def test_mask_seed_alone_decides_masks_and_sparse_weights():
    one, two = (make("SAC", seed=seed, policy_kwargs=dict(mask_seed=7)) for seed in (0, 1))
    for a, b in zip(one.policy.sparse.layers, two.policy.sparse.layers, strict=True):
        np.testing.assert_array_equal(a.dense(), b.dense())


def test_active_weights_are_glorot_by_the_fans_that_are_there():
    model = make("SAC", policy_kwargs=dict(net_arch=[64, 64], sparsity=0.8))
    for layer in model.policy.sparse.layers:
        mask = layer.mask().reshape(layer.shape)
        weights = layer.dense().reshape(layer.shape)
        relative = []
        for i, j in np.argwhere(mask):
            fans = (mask[i].sum() + mask[:, j].sum()) / 2
            relative.append(weights[i, j] / math.sqrt(3 / max(1, fans)))
        assert max(np.abs(relative)) <= 1 + 1e-6
        # Uniform on [-1, 1] has standard deviation 1 / sqrt(3).
        n = len(relative)
        assert np.std(relative) == pytest.approx(1 / math.sqrt(3), abs=2 / math.sqrt(n))
        assert layer.module.bias is None or layer.module.bias.shape == (layer.shape[0],)


@pytest.mark.parametrize(
    ("layer", "gain"),
    [
        ("mlp_extractor.policy_net.0", math.sqrt(2)),
        ("mlp_extractor.value_net.2", math.sqrt(2)),
        ("action_net", 0.01),
        ("value_net", 1.0),
    ],
)
def test_ppo_keeps_its_orthogonal_gains(layer, gain):
    model = make("PPO", policy_kwargs=dict(net_arch=[64, 64], sparsity=0.5))
    found = {each.name: each for each in model.policy.sparse.layers}[layer]
    mask = found.mask().reshape(found.shape)
    weights = np.abs(found.dense().reshape(found.shape))
    limits = np.array(
        [
            [math.sqrt(3 / max(1, (row.sum() + column.sum()) / 2)) for column in mask.T]
            for row in mask
        ]
    )
    ratio = (weights / limits)[mask]
    assert ratio.max() <= gain * (1 + 1e-6)
    assert ratio.max() > 0.8 * gain


def test_without_orthogonal_initialisation_there_is_no_gain():
    model = make("PPO", policy_kwargs=dict(ortho_init=False))
    assert model.policy._initial_gain("action_net") == 1.0


def test_turned_off_it_is_sb3s_own_weights_masked():
    stock = make("SAC", policy="MlpPolicy")
    sparse = make("SAC", policy_kwargs=dict(sparsity_aware_init=False))
    weights = stock.policy.state_dict()
    for layer in sparse.policy.sparse.layers:
        expected = weights[f"{layer.name}.weight"] * layer.module.weight_mask
        assert (layer.weight == expected).all()


def test_biases_are_those_of_sb3():
    stock = make("SAC", policy="MlpPolicy").policy.state_dict()
    sparse = make("SAC").policy.state_dict()
    biases = [key for key in stock if key.endswith("bias")]
    assert biases
    assert all((stock[key] == sparse[key]).all() for key in biases)


def test_a_network_that_starts_dense_keeps_sb3s_weights():
    stock = make("SAC", policy="MlpPolicy").policy.state_dict()
    sparse = make("SAC", policy_kwargs=dict(initial_sparsity=0.0)).policy.state_dict()
    assert all((stock[key] == sparse[key]).all() for key in stock)


def test_targets_start_as_the_masked_network():
    for name in ("SAC", "TD3", "DQN", "TQC", "QRDQN"):
        for layer in make(name).policy.sparse.networks[-1].layers:  # SAC's actor has no target
            assert layer.targets
            assert all((target.weight == layer.weight).all() for target in layer.targets)


def test_masks_do_not_depend_on_and_do_not_touch_the_global_generators():
    th.manual_seed(5)
    state = th.get_rng_state()
    expected = th.rand(())
    th.set_rng_state(state)
    make("DQN", seed=None, policy_kwargs=dict(mask_seed=1))
    stock_state = th.get_rng_state()
    th.set_rng_state(state)
    make("DQN", seed=None, policy="MlpPolicy")
    assert (th.get_rng_state() == stock_state).all()
    assert expected != 0
