"""Modules that a user hands in, and weights that a user's extractor comes with."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from support import ALGORITHMS, arguments_of, assert_masked, make
from torch import nn

from sb3_sparse import SparsityCallback
from sb3_sparse.errors import UnsupportedError

NAMES = sorted(set(ALGORITHMS))
STORED = pytest.mark.parametrize("compute", ["masked", "sparse", "auto"])


class Wrapped(BaseFeaturesExtractor):
    """Whatever it is given, as an extractor."""

    def __init__(self, space, backbone, features_dim=200):
        super().__init__(space, features_dim)
        self.backbone = backbone

    def forward(self, x):
        return self.backbone(x)


class Pretrained(Wrapped):
    """Comes with weights of its own."""

    def __init__(self, space, value=2.0):
        layer = nn.Linear(space.shape[0], 8)
        nn.init.constant_(layer.weight, value)
        super().__init__(space, nn.Sequential(layer, nn.ReLU(), nn.Linear(8, 8)), 8)


def backbone(features: int) -> nn.Sequential:
    th.manual_seed(0)
    return nn.Sequential(nn.Linear(features, 200), nn.ReLU(), nn.Linear(200, 200), nn.ReLU())


def features_of(name: str) -> int:
    return 4 if name in ("DQN", "QRDQN") else 3


@STORED
@pytest.mark.parametrize("name", NAMES)
def test_what_was_handed_in_stays_as_it_was(name, compute, tmp_path):
    given = backbone(features_of(name))
    before = copy.deepcopy(given.state_dict())
    types = [type(module) for module in given.modules()]
    kwargs = dict(
        features_extractor_class=Wrapped,
        features_extractor_kwargs=dict(backbone=given),
        compute=compute,
    )
    models = [make(name, policy_kwargs=copy.copy(kwargs), seed=seed) for seed in (0, 1)]
    for model in models:
        model.learn(30, callback=SparsityCallback("set", update_interval=2))
        assert_masked(model)
    assert [type(module) for module in given.modules()] == types
    assert list(given.state_dict()) == list(before)
    for key, value in given.state_dict().items():
        assert th.equal(value, before[key]), key
    models[0].save(tmp_path / "model")
    loaded = ALGORITHMS[name].load(tmp_path / "model", env=models[0].get_env())
    observation = models[0].observation_space.sample()
    actions = [m.predict(observation, deterministic=True)[0] for m in (models[0], loaded)]
    np.testing.assert_array_equal(*actions)


def test_what_two_arguments_share_they_go_on_sharing():
    shared = nn.Linear(3, 3)
    given = {"one": shared, "many": [shared, {"deep": (shared, 7, "word")}]}
    from sb3_sparse.policies.extractors import copied_modules

    copied = copied_modules(given)
    assert copied["one"] is copied["many"][0] is copied["many"][1]["deep"][0]
    assert copied["one"] is not shared
    assert copied["many"][1]["deep"][1:] == (7, "word")


ONE_FOR_ALL = backbone(4)


class Global(Wrapped):
    """Takes its network from outside, each time the same."""

    def __init__(self, space):
        super().__init__(space, ONE_FOR_ALL)


def test_a_network_that_is_its_own_target_is_refused_by_name():
    with pytest.raises(UnsupportedError, match="one and the same module as q_net_target.*copied"):
        make("DQN", policy_kwargs=dict(features_extractor_class=Global))


@pytest.mark.parametrize("name", ["SAC", "DQN", "TD3"])
def test_weights_of_ones_own_that_are_drawn_anew_are_named_with_the_cure(name):
    kwargs = dict(features_extractor_class=Pretrained)
    with pytest.warns(UserWarning, match=r"backbone\.0 .*sparsity_aware_init=False"):
        make(name, policy_kwargs=dict(kwargs))
    kept = make(name, policy_kwargs=dict(kwargs, sparsity_aware_init=False))
    layers = [layer for layer in kept.policy.sparse.layers if layer.name.endswith("backbone.0")]
    assert layers
    for layer in layers:
        np.testing.assert_array_equal(layer.dense(), 2.0 * layer.mask())


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_weights_that_torch_drew_are_drawn_anew_without_a_word(name, recwarn):
    kwargs = dict(
        features_extractor_class=Wrapped,
        features_extractor_kwargs=dict(backbone=backbone(features_of(name))),
    )
    make(name, policy_kwargs=kwargs)
    assert not [w for w in recwarn if "drawn anew" in str(w.message)]


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_groups_and_settings_of_a_policys_own_optimizer_are_kept(name):
    from sb3_sparse import SparseActorCriticPolicy, SparseSACPolicy

    base = {"SAC": SparseSACPolicy, "PPO": SparseActorCriticPolicy}[name]

    class Grouped(base):
        def _build(self, lr_schedule):
            super()._build(lr_schedule)
            owner = self.actor if name == "SAC" else self
            weights = [p for p in owner.parameters() if p.dim() > 1]
            others = [p for p in owner.parameters() if p.dim() < 2]
            owner.optimizer = th.optim.Adam(
                [{"params": weights, "lr": 0.5}, {"params": others, "betas": (0.1, 0.2)}],
                lr=0.1,
                eps=1e-3,
                amsgrad=True,
            )

    env = "Pendulum-v1"
    model = ALGORITHMS[name](
        Grouped, env, seed=0, policy_kwargs=dict(sparsity=0.9), **arguments_of(ALGORITHMS[name])
    )
    owner = model.policy.actor if name == "SAC" else model.policy
    first, second = owner.optimizer.param_groups
    assert (first["lr"], first["eps"], first["amsgrad"]) == (0.5, 1e-3, True)
    assert second["betas"] == (0.1, 0.2)
    assert first["fused"]
    assert second["fused"]
    model.learn(64)
    assert_masked(model)


def test_a_layer_that_was_parametrized_after_construction_is_named():
    model = make("SAC", policy_kwargs=dict(compute="masked"))
    nn.utils.parametrizations.spectral_norm(model.policy.actor.mu)
    with pytest.raises(UnsupportedError, match=r"the weight of actor\.mu is computed from other"):
        model.learn(30)
    make("PPO").learn(64)  # no other policy is the worse for it


@pytest.mark.skipif("CrossQ" not in ALGORITHMS, reason="sb3-contrib is not installed")
@STORED
def test_crossq_stays_finite_after_the_warm_up_with_constant_units(compute):
    model = make("CrossQ", policy_kwargs=dict(sparsity=0.99, net_arch=[64, 64], compute=compute))
    renorms = [m for m in model.policy.modules() if hasattr(m, "warmup_steps")]
    for module in renorms:
        module.warmup_steps = 5
    model.learn(60)
    assert all(int(module.steps) > 5 for module in renorms if int(module.steps))
    for key, value in model.policy.state_dict().items():
        assert value.dtype.is_floating_point is False or value.isfinite().all(), key


@pytest.mark.skipif("CrossQ" not in ALGORITHMS, reason="sb3-contrib is not installed")
def test_units_that_vary_get_sb3_contribs_own_gradient():
    from sb3_contrib.common.torch_layers import BatchRenorm1d

    from sb3_sparse.policies.contrib import SoundBatchRenorm1d

    found = []
    for cls in (BatchRenorm1d, SoundBatchRenorm1d):
        th.manual_seed(0)
        module = cls(3, warmup_steps=0)
        module.steps += 1
        x = th.randn(7, 3)
        x[:, 1] = 0.25
        x.requires_grad_(True)
        (module(x) ** 3).sum().backward()
        found.append(x.grad)
    stock, ours = found
    assert stock[:, 1].isnan().all()
    assert not ours[:, 1].any()
    assert th.equal(stock[:, [0, 2]], ours[:, [0, 2]])
