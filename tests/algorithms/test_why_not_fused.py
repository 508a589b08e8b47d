"""Which way a model trains: what it says before training, and what the log says of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from algorithms_support import NAMES, STOCK
from support import make

import sb3_sparse

OWN = "Gradient steps are Stable-Baselines3's own: "


def ours(name: str, *args, **kwargs):
    return make(getattr(sb3_sparse, name), *args, **kwargs)


def hooked():
    model = ours("SAC")
    model.critic.qf0[0].register_forward_hook(lambda *_: None)
    return model


def compiled():
    model = ours("PPO")
    model.policy = th.compile(model.policy)
    return model


def frozen():
    model = ours("TD3")
    model.actor.mu[0].weight.requires_grad_(False)
    return model


IMAGES = dict(policy_kwargs={"features_extractor_kwargs": {"features_dim": 8}})
REASONS = {
    "gSDE": lambda: ours("SAC", use_sde=True),
    "the policy, SACPolicy, is not sparse": lambda: ours("SAC", policy="MlpPolicy"),
    "the features extractor NatureCNN": lambda: ours("PPO", "TinyImages-v0", **IMAGES),
    "the features extractor CombinedExtractor": lambda: ours("A2C", "TinyDicts-v0"),
    "the policy is compiled": compiled,
    "hooks on modules": hooked,
    "parameters that are frozen": frozen,
}


@pytest.mark.parametrize("reason", REASONS)
def test_a_model_says_why_its_gradient_steps_are_sb3s(reason):
    assert REASONS[reason]().why_not_fused() == reason


def test_without_kernels_gradient_steps_are_sb3s(monkeypatch):
    monkeypatch.setattr("sb3_sparse.algorithms.training.why_missing", lambda: "no compiler")
    model = ours("DQN")
    assert model.why_not_fused() == "there are no kernels: no compiler"
    model.learn(40)
    assert model._n_updates == 20


@pytest.mark.parametrize("name", NAMES)
def test_asking_changes_nothing(name):
    ends = []
    for asks in (False, True):
        model = ours(name)
        if asks:
            generators = th.get_rng_state(), np.random.get_state()[1]
            assert model.why_not_fused() is None
            assert th.equal(th.get_rng_state(), generators[0])
            assert np.array_equal(np.random.get_state()[1], generators[1])
        model.learn(40)
        assert model.why_not_fused() is None
        model.learn(40, reset_num_timesteps=False)
        ends.append(model.policy.state_dict())
    for key, value in ends[0].items():
        assert th.equal(value, ends[1][key]), key


def test_a_model_says_so_as_it_is_now(tmp_path):
    model = ours("SAC")
    handle = model.actor.mu.register_forward_hook(lambda *_: None)
    assert model.why_not_fused() == "hooks on modules"
    handle.remove()
    assert model.why_not_fused() is None
    model.save(tmp_path / "model.zip")
    assert sb3_sparse.SAC.load(tmp_path / "model.zip").why_not_fused() is None


def logged(capsys, model) -> list[str]:
    model.learn(80)
    return [line for line in capsys.readouterr().out.splitlines() if OWN in line]


def test_the_log_says_once_why(capsys):
    model = ours("SAC", use_sde=True, verbose=1)
    assert logged(capsys, model) == [f"{OWN}gSDE"]
    assert model._n_updates > 40


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("SAC", dict(verbose=1)),  # which is fused
        ("SAC", dict(verbose=0, use_sde=True)),
        ("SAC", dict(verbose=1, policy="MlpPolicy")),
        ("PPO", dict(verbose=1, policy="MlpPolicy")),
    ],
)
def test_the_log_says_nothing_where_there_is_nothing_to_say(name, arguments, capsys):
    assert logged(capsys, ours(name, **arguments)) == []


def test_dense_policies_train_as_in_stock_to_the_bit():
    stock, own = (
        make(package.SAC, policy="MlpPolicy").learn(60).policy.state_dict()
        for package in (STOCK, sb3_sparse)
    )
    for key, value in stock.items():
        assert th.equal(value, own[key]), key
