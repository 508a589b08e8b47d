"""The sparse twin: which weights it keeps, and that everything else comes along."""

from __future__ import annotations

import copy
import functools

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize
from support import ALGORITHMS, assert_masked, make

from sb3_sparse import SparsityCallback, sparsify
from sb3_sparse.errors import ConfigError, UnsupportedError
from sb3_sparse.sparsity.distributions import active_counts

NAMES = sorted(ALGORITHMS)


def trained(name, **kwargs):
    model = make(name, policy="MlpPolicy", **kwargs)
    return model.learn(40)


@pytest.fixture(scope="module")
def trained_once():
    """Trained models of algorithms, for tests that only read them."""
    return functools.cache(trained)


def state(model) -> dict[str, th.Tensor]:
    return {key: value.clone() for key, value in model.policy.state_dict().items()}


def kept_by_hand(weights: np.ndarray, count: int) -> np.ndarray:
    """The ``count`` largest magnitudes, by a stable sort."""
    order = np.argsort(-np.abs(weights.ravel()), kind="stable")
    mask = np.zeros(weights.size, dtype=bool)
    mask[order[:count]] = True
    return mask.reshape(weights.shape)


DENSE = [
    *((name, "MlpPolicy", {}) for name in NAMES),
    *((name, "SparseSimbaPolicy", {"sparsity": 0.0}) for name in NAMES if name != "CrossQ"),
]


@pytest.mark.parametrize(("name", "policy", "kwargs"), DENSE)
def test_every_layer_keeps_its_largest_weights_and_the_model_stays_as_it_is(name, policy, kwargs):
    model = make(name, policy=policy, policy_kwargs=kwargs).learn(40)
    before = state(model)
    twin = sparsify(model, 0.8)
    assert type(twin) is type(model)
    assert twin.num_timesteps == model.num_timesteps
    assert_masked(twin)
    after = state(twin)
    for network in twin.policy.sparse.networks:
        counts = active_counts([layer.shape for layer in network.layers], 0.8)
        for layer, count in zip(network.layers, counts, strict=True):
            dense = before[f"{layer.name}.weight"].numpy()
            kept = kept_by_hand(dense, count)
            np.testing.assert_array_equal(layer.mask(), kept.ravel())
            np.testing.assert_array_equal(after[f"{layer.name}.weight"], np.where(kept, dense, 0))
    for key, value in before.items():
        assert th.equal(value, model.policy.state_dict()[key]), key
        if not key.endswith((".weight", ".weight_mask", "_extra_state")) or value.dim() == 1:
            assert th.equal(value, after[key]), key


@pytest.mark.parametrize("name", NAMES)
def test_it_acts_as_the_dense_model_with_its_small_weights_zeroed(name, trained_once, tmp_path):
    model = trained_once(name)
    twin = sparsify(model, 0.7)
    model.save(tmp_path / "model")
    zeroed = ALGORITHMS[name].load(tmp_path / "model", device="cpu").policy
    weights = zeroed.state_dict()
    for layer in twin.policy.sparse.layers:
        key = f"{layer.name}.weight"
        kept = kept_by_hand(weights[key].numpy(), layer.nnz)
        weights[key] = weights[key] * th.from_numpy(kept)
    zeroed.load_state_dict(weights)
    observations = np.stack([model.observation_space.sample() for _ in range(50)])
    ours, _ = twin.predict(observations, deterministic=True)
    theirs, _ = zeroed.predict(observations, deterministic=True)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_targets_and_moments_are_the_models_where_a_connection_is_kept(name, trained_once):
    model = trained_once(name)
    before = state(model)
    twin = sparsify(model, 0.8)
    names = {id(module): name for name, module in twin.policy.named_modules()}
    for layer in twin.policy.sparse.layers:
        kept = th.from_numpy(layer.mask().reshape(layer.shape))
        for target in layer.targets:
            key = f"{names[id(target)]}.weight"
            assert th.equal(state(twin)[key], before[key] * kept)
    parameters = dict(model.policy.named_parameters())
    masks = {layer.name: layer.mask().reshape(layer.shape) for layer in twin.policy.sparse.layers}
    compared = 0
    for key, parameter in twin.policy.named_parameters():
        for ours, theirs in zip(optimizers(twin), optimizers(model), strict=True):
            for what, value in ours.state.get(parameter, {}).items():
                expected = theirs.state[parameters[key]][what]
                if key.removesuffix(".weight") in masks and value.dim():
                    expected = expected * th.from_numpy(masks[key.removesuffix(".weight")])
                assert th.equal(value, expected), (key, what)
                compared += 1
    assert compared > 0
    if hasattr(model, "log_ent_coef") and model.log_ent_coef is not None:
        assert th.equal(twin.log_ent_coef, model.log_ent_coef)
        ours, theirs = (m.ent_coef_optimizer.state_dict()["state"] for m in (twin, model))
        assert str(ours) == str(theirs)


def optimizers(model) -> list[th.optim.Optimizer]:
    parts = [model.policy, getattr(model.policy, "actor", None), getattr(model, "critic", None)]
    return [part.optimizer for part in parts if getattr(part, "optimizer", None) is not None]


@pytest.mark.parametrize("name", NAMES)
def test_it_is_saved_loaded_copied_and_trained_on(name, tmp_path):
    model = trained(name)
    twin = sparsify(model, 0.8)
    twin.save(tmp_path / "twin")
    loaded = type(twin).load(tmp_path / "twin", env=model.env, device="cpu")
    for key, value in state(twin).items():
        assert th.equal(value, loaded.policy.state_dict()[key]), key
    copied = copy.deepcopy(twin.policy)
    for key, value in state(twin).items():
        assert th.equal(value, copied.state_dict()[key]), key
    masks = [layer.mask() for layer in twin.policy.sparse.layers]
    before = [layer.dense().copy() for layer in twin.policy.sparse.layers]
    steps = twin.num_timesteps
    twin.learn(40, reset_num_timesteps=False)
    assert twin.num_timesteps >= steps + 40
    assert_masked(twin)
    for mask, layer in zip(masks, twin.policy.sparse.layers, strict=True):
        np.testing.assert_array_equal(mask, layer.mask())
    changed = [
        not np.array_equal(old, layer.dense())
        for old, layer in zip(before, twin.policy.sparse.layers, strict=True)
    ]
    assert any(changed)


@pytest.mark.parametrize("name", NAMES)
def test_a_sparse_model_loses_the_least_of_what_it_has(name):
    model = make(name).learn(80, callback=SparsityCallback("rigl", update_interval=5))
    active = [layer.mask() for layer in model.policy.sparse.layers]
    dense = [layer.dense().copy() for layer in model.policy.sparse.layers]
    twin = sparsify(model, 0.95)
    assert_masked(twin)
    for mask, weights, layer in zip(active, dense, twin.policy.sparse.layers, strict=True):
        kept = layer.mask()
        assert not (kept & ~mask).any()
        assert kept.sum() == layer.nnz < mask.sum()
        assert np.abs(weights[kept]).min() >= np.abs(weights[mask & ~kept]).max()
    clocks = [network.clock for network in model.policy.sparse.networks]
    assert [network.clock for network in twin.policy.sparse.networks] == clocks


def test_a_freshly_grown_weight_counts_as_active_before_what_is_inactive():
    model = make("PPO")
    layer = next(iter(model.policy.sparse.layers))
    with th.no_grad():
        layer.weight.zero_()
    twin = sparsify(model, 0.95)
    assert not (next(iter(twin.policy.sparse.layers)).mask() & ~layer.mask()).any()


def test_a_sparse_model_cannot_become_denser():
    model = make("SAC")
    with pytest.raises(ConfigError, match=r"can only lose connections. .*'actor': 0.9"):
        sparsify(model, 0.5)
    with pytest.raises(ConfigError, match="can only lose connections"):
        sparsify(model, {"actor": 0.95, "critic": 0.8})
    with pytest.raises(ConfigError, match="leave distribution and dense_layers out"):
        sparsify(model, 0.9, distribution="uniform")
    same = sparsify(model, 0.9)
    for key, value in state(model).items():
        assert th.equal(value, same.policy.state_dict()[key]), key


@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_networks_have_sparsities_of_their_own_in_every_storage(compute):
    model = trained("SAC")
    twin = sparsify(
        model,
        {"actor": 0.9, "critic": 0.0},
        distribution="uniform",
        dense_layers=["output"],
        compute=compute,
    )
    sparse = twin.policy.sparse
    assert {n.name: n.nnz for n in sparse.networks if n.name == "critic"} == {
        n.name: n.size for n in sparse.networks if n.name == "critic"
    }
    actor = sparse.networks[0]
    # 3-24-24: 72 and 576 connections, of which 0.9 * 72 = 64.8 and 518.4 go, rounded down
    assert [layer.nnz for layer in actor.layers] == [8, 58]
    assert [layer.is_sparse for layer in actor.layers] == [compute == "sparse"] * 2
    further = sparsify(twin, {"actor": 0.95, "critic": 0.0})
    config = further.policy.sparsity_config
    assert (config.distribution, config.compute) == ("uniform", compute)
    assert list(config.dense_layers) == ["output"]
    assert [layer.nnz for layer in further.policy.sparse.networks[0].layers] == [4, 29]
    further.learn(40, reset_num_timesteps=False)
    assert_masked(further)


def test_images_keep_their_extractor_and_what_it_shares():
    for name in ("DQN", "PPO"):
        model = make(name, env="TinyImages-v0", policy="CnnPolicy").learn(80)
        twin = sparsify(model, 0.9)
        assert type(twin.policy).__name__ in ("SparseDQNCnnPolicy", "SparseActorCriticCnnPolicy")
        assert_masked(twin)
        assert twin.policy.sparse.sparsity == pytest.approx(0.9, abs=0.01)
        twin.learn(64, reset_num_timesteps=False)
        assert_masked(twin)


def test_an_image_flattened_by_an_mlp_policy_stays_flat():
    model = make("DQN", env="TinyImages-v0", policy="MlpPolicy")
    names = {layer.name for layer in sparsify(model, 0.9).policy.sparse.layers}
    assert names == {f"q_net.q_net.{index}" for index in (0, 2, 4)}


def test_policy_arguments_of_the_user_survive():
    kwargs = dict(net_arch=dict(pi=[8], vf=[12, 12]), activation_fn=th.nn.ReLU, ortho_init=False)
    model = make("PPO", policy="MlpPolicy", policy_kwargs=kwargs)
    twin = sparsify(model, 0.5)
    assert twin.policy.activation_fn is th.nn.ReLU
    assert twin.policy.mlp_extractor.latent_dim_vf == 12
    assert twin.policy.ortho_init is False
    assert "sparsity" not in model.policy_kwargs


def test_environment_normalisation_and_replay_buffer_are_taken_over():
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=1, seed=0))
    model = make("SAC", env=env, policy="MlpPolicy").learn(60)
    twin = sparsify(model, 0.9)
    assert twin.get_vec_normalize_env() is env
    assert twin.replay_buffer is model.replay_buffer
    assert twin.replay_buffer.size() == 60
    np.testing.assert_array_equal(twin._last_obs, model._last_obs)


def test_a_model_without_environment_has_a_twin_that_predicts(tmp_path):
    make("PPO", policy="MlpPolicy").save(tmp_path / "model")
    model = PPO.load(tmp_path / "model", device="cpu")
    twin = sparsify(model, 0.9)
    assert twin.env is None
    action, _ = twin.predict(model.observation_space.sample())
    assert action.shape == (1,)


def test_nothing_hangs_on_the_generator():
    model = make("PPO", policy="MlpPolicy", seed=None)
    twins = []
    for seed in (1, 2):
        th.manual_seed(seed)
        twins.append(sparsify(model, 0.9))
    for key, value in state(twins[0]).items():
        assert th.equal(value, twins[1].policy.state_dict()[key]), key


class OwnPolicy(ActorCriticPolicy):
    """What a user might write."""


def test_what_has_no_sparse_counterpart_is_refused():
    own = PPO(OwnPolicy, "CartPole-v1", n_steps=32, batch_size=16)
    with pytest.raises(UnsupportedError, match=r"OwnPolicy is not one of SB3's own for PPO \(Mlp"):
        sparsify(own, 0.9)
    contrib = pytest.importorskip("sb3_contrib")
    recurrent = contrib.RecurrentPPO("MlpLstmPolicy", "CartPole-v1", n_steps=32)
    with pytest.raises(UnsupportedError, match="RecurrentPPO has no sparse policy; supported are"):
        sparsify(recurrent, 0.9)
    with pytest.raises(ConfigError, match=r"must lie in \[0, 1\)"):
        sparsify(make("PPO", policy="MlpPolicy"), 1.0)
