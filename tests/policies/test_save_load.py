"""Saving, loading, copying, resuming: masks, clocks, seeds and moments survive."""

from __future__ import annotations

import base64
import copy
import json
import pickle
import subprocess
import sys
import zipfile
from itertools import product

import numpy as np
import pytest
import torch as th
from support import ALGORITHMS, assert_masked, make

from sb3_sparse import SparsityCallback
from sb3_sparse.errors import CorruptStateError, UnsupportedError
from sb3_sparse.policies.base import BaseSparsePolicy

NAMES = sorted(ALGORITHMS)
WITH_SDE = ("A2C", "CrossQ", "PPO", "SAC", "TQC", "TRPO")


def rigl(**kwargs) -> SparsityCallback:
    return SparsityCallback("rigl", **{"update_interval": 5, **kwargs})


def state_of(model) -> dict[str, object]:
    """Everything that training goes on from, apart from the replay buffer."""
    sparse = model.policy.sparse
    moments = [
        value
        for optimizer in sparse.optimizers
        for parameter in optimizer.param_groups[0]["params"]
        for value in optimizer.state.get(parameter, {}).values()
    ]
    return {
        "tensors": {key: value.clone() for key, value in model.policy.state_dict().items()},
        "moments": [value.clone() for value in moments],
        "seed": sparse.seed,
        "clocks": [network.clock for network in sparse.networks],
        "nnz": [layer.nnz for layer in sparse.layers],
    }


def assert_same(one: dict, two: dict) -> None:
    assert one["tensors"].keys() == two["tensors"].keys()
    for key, value in one["tensors"].items():
        assert th.equal(value, two["tensors"][key]), key
    assert len(one["moments"]) == len(two["moments"])
    for a, b in zip(one["moments"], two["moments"], strict=True):
        assert th.equal(a, b)
    assert {k: one[k] for k in ("seed", "clocks", "nnz")} == {
        k: two[k] for k in ("seed", "clocks", "nnz")
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_saved_model_comes_back_as_it_was_and_trains_on(name, tmp_path):
    model = make(name, policy_kwargs=dict(weight_decay=1e-4))
    model.learn(40, callback=rigl(update_interval=4))
    model.save(tmp_path / "model")
    loaded = ALGORITHMS[name].load(tmp_path / "model", env=model.env, device="cpu")
    assert_same(state_of(model), state_of(loaded))
    loaded.learn(40, callback=rigl(update_interval=4), reset_num_timesteps=False)
    assert_masked(loaded)
    assert loaded.num_timesteps >= 80
    for before, after in zip(
        model.policy.sparse.networks, loaded.policy.sparse.networks, strict=True
    ):
        assert after.clock > before.clock


@pytest.mark.parametrize("name", NAMES)
def test_a_saved_policy_comes_back_as_it_was(name, tmp_path):
    model = make(name, policy_kwargs=dict(dense_layers=["output"], weight_decay=1e-4))
    model.learn(40, callback=rigl(update_interval=4))
    model.policy.save(tmp_path / "policy.pth")
    loaded = type(model.policy).load(tmp_path / "policy.pth", device="cpu")
    for key, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.state_dict()[key]), key
    assert str(loaded.sparsity_report()) == str(model.policy.sparsity_report())
    observation = model.observation_space.sample()
    ours, _ = model.policy.predict(observation, deterministic=True)
    theirs, _ = loaded.predict(observation, deterministic=True)
    np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("name", ["SAC", "PPO", "TD3"])
def test_a_saved_policy_with_a_shared_extractor_comes_back(name, compute, tmp_path):
    import gymnasium as gym

    kwargs = dict(
        share_features_extractor=name != "PPO",
        features_extractor_kwargs=dict(features_dim=8),
        net_arch=[8],
        compute=compute,
    )
    model = make(name, gym.make("TinyImages-v0", discrete=False), policy_kwargs=kwargs)
    model.policy.save(tmp_path / "policy.pth")
    loaded = type(model.policy).load(tmp_path / "policy.pth", device="cpu")
    assert loaded.share_features_extractor == kwargs["share_features_extractor"]
    assert {layer.is_sparse for layer in loaded.sparse.layers} == {compute == "sparse"}
    for key, value in model.policy.state_dict().items():
        np.testing.assert_array_equal(loaded.state_dict()[key], value, err_msg=key)


@pytest.mark.parametrize(
    ("name", "use_sde"), [(n, False) for n in NAMES] + [(n, True) for n in WITH_SDE]
)
def test_a_deep_copy_trains_sparsely_and_leaves_the_original_alone(name, use_sde):
    model = make(name, **({"use_sde": True} if use_sde else {}))
    model.learn(40, callback=rigl(update_interval=4))
    before = state_of(model)
    twin = copy.deepcopy(model.policy)
    original, model.policy = model.policy, twin
    if hasattr(model, "_create_aliases"):
        model._create_aliases()
    model.learn(40, callback=rigl(update_interval=4))
    assert_masked(model)
    clocks = [network.clock for network in twin.sparse.networks]
    assert all(new > old for new, old in zip(clocks, before["clocks"], strict=True))
    model.policy = original
    assert_same(before, state_of(model))


def test_a_pickled_policy_comes_back_with_its_masks():
    policy = make("SAC").policy
    twin = pickle.loads(pickle.dumps(policy))
    for key, value in policy.state_dict().items():
        assert th.equal(value, twin.state_dict()[key]), key


STARTS = {"prune": 0.0, "granet": 0.45}


@pytest.mark.parametrize(
    ("name", "method"),
    [
        *product(["SAC", "DQN", "PPO"], ["set", "rigl", "prune", "granet"]),
        *product(["SAC", "PPO"], [{"critic": "rigl"}, {"actor": "set", "critic": "granet"}]),
    ],
)
def test_a_resumed_run_makes_the_moves_of_an_uninterrupted_one(name, method, tmp_path):
    """Given the same data and random numbers, bit for bit."""
    if isinstance(method, str):
        start = STARTS.get(method)
    else:
        start = {network: STARTS[one] for network, one in method.items() if one in STARTS}
    model = make(name, policy_kwargs=dict(initial_sparsity=start))
    options = dict(update_interval=4, begin=0.0)
    if isinstance(method, dict):
        options["update_on"] = {"critic": "rollout"}
    model.learn(64, callback=SparsityCallback(method, **options))
    model.save(tmp_path / "model")
    resumed = ALGORITHMS[name].load(tmp_path / "model", env=model.env, device="cpu")
    if hasattr(model, "replay_buffer"):
        model.save_replay_buffer(tmp_path / "buffer")
        resumed.load_replay_buffer(tmp_path / "buffer")
    else:
        resumed.rollout_buffer = copy.deepcopy(model.rollout_buffer)
    plans = SparsityCallback(method, **options).plans
    for each in (model, resumed):
        each.set_logger(model.logger)
        sparse = each.policy.sparse
        sparse.progress = 0.3
        sparse.start(plans, soft_targets=name == "SAC", in_force=lambda: True)
        np.random.seed(1)
        th.manual_seed(1)
        for _ in range(3):
            if name == "PPO":
                each.train()
            else:
                each.train(gradient_steps=4, batch_size=16)
            sparse.flush()
        sparse.stop()
    assert model.policy.sparse.networks[-1].mask_updates > 0
    assert_same(state_of(model), state_of(resumed))


def test_the_zip_holds_no_pickled_object_of_ours_but_the_policys_class(tmp_path):
    model = make("SAC", policy_kwargs=dict(dense_layers=["output"], weight_decay=1e-4))
    model.learn(40, callback=rigl())
    model.save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
        with archive.open("policy.pth") as file:
            tensors = th.load(file, weights_only=True)
    assert all(isinstance(value, th.Tensor) for value in tensors.values())
    pickled = {
        key: base64.b64decode(value[":serialized:"])
        for key, value in data.items()
        if isinstance(value, dict) and ":serialized:" in value
    }
    assert "policy_class" in pickled
    assert [key for key, raw in pickled.items() if b"sb3_sparse" in raw] == ["policy_class"]
    kwargs = {k: v for k, v in data["policy_kwargs"].items() if not k.startswith(":")}
    assert kwargs["sparsity"] == 0.9
    assert kwargs["dense_layers"] == ["output"]


def test_a_fresh_process_needs_no_import_of_the_plugin_to_load(tmp_path):
    model = make("SAC")
    model.learn(40, callback=rigl())
    model.save(tmp_path / "model.zip")
    script = (
        "import sys; from stable_baselines3 import SAC; "
        f"policy = SAC.load({str(tmp_path / 'model.zip')!r}, device='cpu').policy; "
        "print([layer.nnz for layer in policy.sparse.layers], policy.sparse.networks[0].clock)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    sparse = model.policy.sparse
    expected = f"{[layer.nnz for layer in sparse.layers]} {sparse.networks[0].clock}"
    assert done.stdout.strip() == expected


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_weights_of_a_dense_model_are_masked_when_set(name, tmp_path):
    dense = make(name, policy="MlpPolicy")
    dense.learn(40)
    dense.save(tmp_path / "dense")
    model = make(name)
    masks = [layer.mask() for layer in model.policy.sparse.layers]
    model.set_parameters(tmp_path / "dense.zip", exact_match=False)
    weights = dense.policy.state_dict()
    for layer, mask in zip(model.policy.sparse.layers, masks, strict=True):
        np.testing.assert_array_equal(layer.mask(), mask)
        expected = weights[f"{layer.name}.weight"] * layer.module.weight_mask
        assert (layer.weight == expected).all()
        for target in layer.targets:
            assert not target.weight[~layer.module.weight_mask].any()
    model.learn(40)
    assert_masked(model)


def test_set_parameters_takes_masks_and_clocks_of_another_sparse_model():
    one, two = make("SAC", seed=1), make("SAC", seed=2)
    one.learn(60, callback=rigl())
    two.set_parameters(one.get_parameters())
    assert_same(state_of(one), state_of(two))


def test_the_mask_seed_that_growth_uses_is_saved(tmp_path):
    model = make("SAC", seed=None, policy_kwargs=dict(mask_seed=None))
    model.save(tmp_path / "model")
    th.manual_seed(12345)
    loaded = ALGORITHMS["SAC"].load(tmp_path / "model", device="cpu")
    assert loaded.policy.sparse.seed == model.policy.sparse.seed


def test_masks_of_another_sparsity_are_refused_before_anything_is_loaded():
    denser, model = make("SAC", policy_kwargs=dict(sparsity=0.5)), make("SAC")
    before = state_of(model)
    with pytest.raises(CorruptStateError, match=r"policy of this sparsity has \d+\. Load"):
        model.set_parameters(denser.get_parameters())
    assert_same(before, state_of(model))


def test_a_dense_checkpoint_can_be_pruned_with_weight_decay_and_stays_fused():
    dense = make("PPO", policy="MlpPolicy")
    dense.learn(64)
    model = make("PPO", policy_kwargs=dict(initial_sparsity=0.0, weight_decay=1e-4))
    model.set_parameters(dense.get_parameters(), exact_match=False)
    assert model.policy.optimizer.param_groups[0]["fused"] is True
    model.learn(128, callback=SparsityCallback("prune", update_interval=2))
    assert_masked(model)


def test_weights_set_from_a_vector_are_masked():
    policy = make("PPO").policy
    policy.load_from_vector(np.ones(policy.parameters_to_vector().shape))
    for layer in policy.sparse.layers:
        np.testing.assert_array_equal(layer.dense(), layer.mask().astype(np.float32))


@pytest.mark.parametrize(
    "state", [th.zeros(2, dtype=th.int64), th.tensor([-1, 0, 0, 0, 0, 0]), {"seed": 1}]
)
def test_a_damaged_state_is_refused(state):
    policy = make("SAC").policy
    damaged = dict(policy.state_dict(), _extra_state=state)
    with pytest.raises(CorruptStateError, match="must be 6 numbers"):
        policy.load_state_dict(damaged)


def test_every_policy_class_can_be_pickled_by_name():
    for algorithm in ALGORITHMS.values():
        for prefix in ("", "Mlp", "Cnn", "MultiInput"):
            policy = algorithm.policy_aliases.get(f"Sparse{prefix}Policy")
            if policy is None:
                assert algorithm.__name__ == "CrossQ"
                continue
            assert issubclass(policy, BaseSparsePolicy)
            assert pickle.loads(pickle.dumps(policy)) is policy


def test_copies_and_pickles_save_moments_in_the_common_form():
    model = make("SAC", policy_kwargs=dict(compute="sparse")).learn(25)
    policy = model.policy
    for twin in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        for one, other in zip(policy.sparse.optimizers, twin.sparse.optimizers, strict=True):
            for number, state in one.state_dict()["state"].items():
                for key, value in state.items():
                    np.testing.assert_array_equal(other.state_dict()["state"][number][key], value)
                    assert value.dim() != 1 or value.shape[0] in (24, 1)  # biases only


def test_a_policy_that_cannot_change_its_type_does_not_change_in_part():
    policy = make("SAC", policy_kwargs=dict(compute="sparse", dense_layers=["input"])).policy
    with pytest.raises(UnsupportedError, match="stay float32 on the CPU"):
        policy.double()
    assert {p.dtype for p in policy.parameters()} == {th.float32}
    assert policy.to("cpu") is policy
