from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from support import assert_masked, make
from torch import nn
from torch.nn import functional

from sb3_sparse import SparsityCallback
from sb3_sparse.engine.auto import chains_of, choose, image_chains_of
from sb3_sparse.engine.masked import MaskedStorage
from sb3_sparse.engine.native import library
from sb3_sparse.engine.residual import Residual
from sb3_sparse.errors import UnsupportedError


class All:
    """A container of everything."""

    def __contains__(self, name: object) -> bool:
        return True


def layers_of(root: nn.Module, density: float = 0.2) -> list[MaskedStorage]:
    layers = []
    for name, module in root.named_modules():
        if isinstance(module, (nn.Linear, nn.Conv2d)):
            layer = MaskedStorage(name, module)
            layer.set_mask(np.arange(layer.size) < round(density * layer.size))
            layers.append(layer)
    return layers


def test_runs_are_linear_layers_with_activations_between_them():
    root = nn.Sequential(
        nn.Sequential(
            nn.Linear(2, 3), nn.ReLU(), nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 5)
        ),
        nn.Conv2d(1, 1, 1),
        nn.Linear(6, 7),
    )
    names = [[layer.name for layer in run] for run in chains_of(root, layers_of(root))]
    assert names == [["2"], ["0.0", "0.2"], ["0.4"]]


@pytest.fixture
def use():
    before = library.in_use()
    yield library.use
    library.use(before)


@pytest.mark.parametrize("instructions", library.instruction_sets())
def test_a_chain_is_sparse_if_a_layer_in_it_is_large_and_sparse_enough(use, instructions):
    use(instructions)
    most = 0.5 if instructions in ("avx512", "avx2") else 0.25
    root = nn.Sequential(
        nn.Linear(8, 128), nn.Tanh(), nn.Linear(128, 64), nn.LayerNorm(64), nn.Linear(64, 3)
    )  # 128 x 64 = 8,192 = 2**13
    assert choose(root, layers_of(root, most), All()) == ["0", "2"]
    assert choose(root, layers_of(root, most + 0.01), All()) == []
    assert choose(root, layers_of(root, most), {"0", "4"}) == []
    root[2] = nn.Linear(128, 63)
    assert choose(root, layers_of(root, 0.1), All()) == []


@pytest.mark.parametrize("instructions", library.instruction_sets())
def test_a_huge_layer_must_be_sparser(use, instructions):
    use(instructions)
    most = 0.4 if instructions in ("avx512", "avx2") else 0.25
    root = nn.Sequential(nn.Linear(513, 512))
    assert choose(root, layers_of(root, most), All()) == ["0"]
    assert choose(root, layers_of(root, most + 0.01), All()) == []


def test_chains_of_images_are_convolutions_with_what_the_kernels_compute_between_them():
    class Own(nn.Module):
        def __init__(self):
            super().__init__()
            self.conv = nn.Conv2d(2, 2, 1)

    root = nn.Sequential(
        nn.Conv2d(1, 2, 3),
        nn.ReLU(),
        nn.MaxPool2d(2),
        Residual(nn.ReLU(), nn.Conv2d(2, 2, 3, padding=1)),
        nn.Conv2d(2, 2, 1),
        nn.AvgPool2d(2),
        nn.Conv2d(2, 2, 1),
        nn.Conv2d(2, 2, 1, groups=2),  # which the kernels do not compute
        nn.Conv2d(2, 2, 1),
        Own(),
        nn.Flatten(),
        nn.Linear(2, 2),
    )
    names = [[layer.name for layer in run] for run in image_chains_of(root, layers_of(root))]
    assert names == [["0", "3.residual.1", "4"], ["6"], ["8"], ["9.conv"]]


@pytest.mark.parametrize("instructions", library.instruction_sets())
def test_convolutions_are_sparse_if_all_together_are_sparse_enough(use, instructions):
    use(instructions)
    most = 0.5 if instructions in ("avx512", "avx2") else 0.25
    root = nn.Sequential(nn.Conv2d(1, 16, 2), nn.ReLU(), nn.Conv2d(16, 15, 2))
    layers = layers_of(root, most)  # 64 and 960 connections
    assert choose(root, layers, All()) == ["0", "2"]
    assert choose(root, layers, {"2"}) == ["2"]
    layers[0].set_mask(np.ones(64, np.bool_))  # the first is dense,
    layers[1].set_mask(np.arange(960) < 1024 * most - 64)  # and the second makes up for it
    assert choose(root, layers, All()) == ["0", "2"]
    layers[1].set_mask(np.arange(960) < 1024 * most - 63)
    assert choose(root, layers, All()) == []


def test_missing_kernels_keep_masks(monkeypatch, tmp_path):
    root = nn.Sequential(nn.Linear(400, 400))
    assert choose(root, layers_of(root), All()) == ["0"]
    monkeypatch.setattr(library, "PATH", tmp_path / "none.so")
    library.library.cache_clear()
    found = choose(root, layers_of(root), All())
    library.library.cache_clear()
    assert found == []


def large(name: str = "SAC", **policy_kwargs):
    kwargs = dict(net_arch=[200, 200], compute="auto", **policy_kwargs)
    return make(name, policy_kwargs=kwargs)


def sparse_names(model) -> list[str]:
    return [layer.name for layer in model.policy.sparse.layers if layer.is_sparse]


def test_storage_is_decided_when_the_policy_is_built_and_shapes_stay(tmp_path):
    model = large()
    names = sparse_names(model)
    assert names == [
        f"{part}.{layer}"
        for part, layers in (("actor.latent_pi", (0, 2)), ("critic.qf0", (0, 2, 4)),
                             ("critic.qf1", (0, 2, 4)))
        for layer in layers
    ]  # fmt: skip
    averaged = th.optim.swa_utils.AveragedModel(model.policy.critic)
    shapes = [parameter.shape for parameter in model.policy.parameters()]
    model.learn(40, callback=SparsityCallback("rigl", update_interval=4))
    assert [parameter.shape for parameter in model.policy.parameters()] == shapes
    averaged.update_parameters(model.policy.critic)
    model.save(tmp_path / "model")
    assert sparse_names(SAC.load(tmp_path / "model")) == names


def test_a_pruned_policy_changes_its_storage_once_it_is_sparse_enough(tmp_path):
    model = large(initial_sparsity=0.0)
    assert sparse_names(model) == []
    model.learn(60, callback=SparsityCallback("prune", update_interval=1, begin=0.4, end=0.9))
    assert "critic.qf1.2" in sparse_names(model)
    assert_masked(model)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model")
    assert sparse_names(loaded) == sparse_names(model)
    assert_masked(loaded)
    moments = [m.critic.optimizer.state_dict()["state"] for m in (model, loaded)]
    for number, state in moments[0].items():
        for key, value in state.items():
            assert th.equal(value, moments[1][number][key]), (number, key)


@pytest.mark.parametrize("where", [th.float64, "meta"])
def test_a_policy_that_leaves_float32_on_the_cpu_goes_back_to_masks(where):
    model = large()
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    model.learn(25, callback=SparsityCallback("set", update_interval=2))
    model.policy.load_state_dict(before)
    model.policy.to(where)
    assert sparse_names(model) == []
    if where == "meta":
        return
    for key, value in model.policy.state_dict().items():
        np.testing.assert_array_equal(value, before[key], err_msg=key)
    twin = copy.deepcopy(model.policy)
    x = th.zeros(3, 3, dtype=th.float64)
    assert th.equal(model.policy.actor.latent_pi(x), twin.actor.latent_pi(x))
    model.policy.to(th.float32)
    model.learn(30, callback=SparsityCallback("set", update_interval=2))
    assert sparse_names(model) == []
    assert_masked(model)


def test_moments_and_targets_survive_the_way_back_to_masks():
    model = large().learn(30, callback=SparsityCallback("set", update_interval=2))
    moments = model.critic.optimizer.state_dict()
    target = {k: v.clone() for k, v in model.critic_target.state_dict().items()}
    model.policy.sparse.to_masked(model.policy)
    for key, value in model.critic_target.state_dict().items():
        assert th.equal(value, target[key])
    for number, state in model.critic.optimizer.state_dict()["state"].items():
        for key, value in state.items():
            assert th.equal(value, moments["state"][number][key]), (number, key)
    model.learn(30, callback=SparsityCallback("set", update_interval=2))
    assert_masked(model)


class Tied(BaseFeaturesExtractor):
    """Two layers, the second of which is the first transposed."""

    def __init__(self, space):
        super().__init__(space, 200)
        self.first = nn.Linear(space.shape[0], 200)
        self.second = nn.Linear(200, 200)

    def forward(self, x):
        h = self.second(self.first(x).relu())
        return functional.linear(h, self.second.weight.t()).relu()


class Attentive(BaseFeaturesExtractor):
    """torch's transformer layer, which reads its layers' weights in evaluation mode."""

    def __init__(self, space):
        super().__init__(space, 64)
        self.embed = nn.Linear(space.shape[0], 64)
        self.layer = nn.TransformerEncoderLayer(64, 2, 1024, batch_first=True, dropout=0.0)

    def forward(self, x):
        return self.layer(self.embed(x).unsqueeze(1)).squeeze(1)


class Shared(BaseFeaturesExtractor):
    """One Parameter in two layers."""

    def __init__(self, space):
        super().__init__(space, 200)
        self.layers = nn.Sequential(
            nn.Linear(space.shape[0], 200), nn.ReLU(), nn.Linear(200, 200), nn.Linear(200, 200)
        )
        self.layers[3].weight = self.layers[2].weight

    def forward(self, x):
        return self.layers(x)


DENSE = {Attentive: ["*.self_attn"]}


@pytest.mark.parametrize("extractor", [Tied, Attentive, Shared])
@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_weights_that_are_read_otherwise_than_by_their_layer_stay_matrices(name, extractor):
    model = large(name, features_extractor_class=extractor, dense_layers=DENSE.get(extractor, []))
    model.learn(50, callback=SparsityCallback("set", update_interval=4))
    model.predict(model.observation_space.sample())
    names = sparse_names(model)
    assert names
    assert not any("features_extractor" in name for name in names)
    assert_masked(model)


@pytest.mark.parametrize("extractor", [Attentive, Shared])
def test_sparse_stores_what_the_user_calls_and_never_what_torch_reads(extractor):
    model = make(
        "PPO",
        policy_kwargs=dict(
            compute="sparse",
            features_extractor_class=extractor,
            dense_layers=DENSE.get(extractor, []),
        ),
    )
    names = sparse_names(model)
    inner = "embed" if extractor is Attentive else "layers.0"
    assert f"features_extractor.{inner}" in names or f"pi_features_extractor.{inner}" in names
    assert not any("linear1" in name or name.endswith(("layers.2", "layers.3")) for name in names)
    model.learn(64)
    model.predict(model.observation_space.sample())


def test_only_the_user_can_undo_sparse():
    model = make("SAC", policy_kwargs=dict(compute="sparse"))
    with pytest.raises(UnsupportedError, match="make the policy with compute='masked'"):
        model.policy.double()
    assert sparse_names(model)
