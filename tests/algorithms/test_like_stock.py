"""Gradient steps of every algorithm end as those of stock SB3 with the same policy."""

from __future__ import annotations

import pytest
from algorithms_support import (
    DISCRETE,
    METHODS,
    NAMES,
    STOCK,
    assert_alike,
    assert_like_stock,
    learn,
    make,
    moving,
    policy_kwargs_of,
)

import sb3_sparse


def assert_networks_alike(ours, stock):
    for one, two in zip(ours.policy.sparse.networks, stock.policy.sparse.networks, strict=True):
        assert (one.clock, one.mask_updates) == (two.clock, two.mask_updates)


@pytest.mark.parametrize("storage", ["masked", "sparse"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", NAMES)
def test_gradient_steps_of_every_method(name, method, storage):
    kwargs = policy_kwargs_of(method, storage)
    ours, stock = assert_like_stock(name, lambda: moving(method), policy_kwargs=kwargs)
    assert_networks_alike(ours, stock)
    steps = 30 if name == "PPO" else 20
    for network in ours.policy.sparse.networks:
        delayed = name in ("TD3", "CrossQ") and network.name == "actor"
        assert network.clock == (10 if delayed else steps)
        assert (network.mask_updates > 2) == (method not in ("static", "dense"))


@pytest.mark.parametrize("method", ["rigl"])
@pytest.mark.parametrize("name", NAMES)
def test_layers_that_auto_makes_sparse(name, method):
    kwargs = dict(policy_kwargs_of(method, "auto"), sparsity=0.95, net_arch=[160, 80])
    ours, stock = assert_like_stock(name, lambda: moving(method), policy_kwargs=kwargs)
    assert_networks_alike(ours, stock)
    assert any(layer.is_sparse for layer in ours.policy.sparse.layers)


@pytest.mark.parametrize("method", ["set", "rigl", "prune", "granet"])
@pytest.mark.parametrize("name", NAMES)
def test_many_updates_move_the_same_connections(name, method):
    # With SB3's epsilon all that has just grown moves by the learning rate, and is as good to drop.
    kwargs = dict(policy_kwargs_of(method), optimizer_kwargs=dict(eps=1e-2))
    ours, stock = assert_like_stock(
        name, lambda: moving(method, update_interval=1), policy_kwargs=kwargs
    )
    assert_networks_alike(ours, stock)
    due = [[n.updates_due for n in model.policy.sparse.networks] for model in (ours, stock)]
    assert due[0] == due[1]
    assert sum(due[0]) >= 19
    assert ours.policy.sparse.networks[-1].mask_updates >= (3 if method == "prune" else 14)


MIXED = [
    ({"actor": "static", "critic": "rigl"}, {}),
    ({"actor": "set", "critic": "static"}, {}),
    ({"actor": "rigl", "critic": "prune"}, {"critic": 0.2}),
    ({"critic": "granet"}, {"critic": 0.3}),
]


@pytest.mark.parametrize("storage", ["masked", "sparse"])
@pytest.mark.parametrize(("methods", "start"), MIXED, ids=[str(methods) for methods, _ in MIXED])
@pytest.mark.parametrize("name", [name for name in NAMES if name not in DISCRETE])
def test_a_method_for_each_network(name, methods, start, storage):
    kwargs = dict(compute=storage, sparsity=0.7, initial_sparsity=start)
    options = dict(update_interval={"actor": 2, "critic": 3}, begin=0.0, end=1.0)
    options["update_interval"] = {
        network: options["update_interval"][network]
        for network, method in methods.items()
        if method != "static"
    }
    ours, stock = assert_like_stock(
        name, lambda: sb3_sparse.SparsityCallback(methods, **options), policy_kwargs=kwargs
    )
    assert_networks_alike(ours, stock)
    for network in ours.policy.sparse.networks:
        assert (network.mask_updates > 2) == (methods.get(network.name, "static") != "static")


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_a_method_of_a_third_party(name):
    assert_networks_alike(*assert_like_stock(name, lambda: moving("least-index")))


@pytest.mark.parametrize("name", NAMES)
def test_updates_that_wait_for_the_rollout(name):
    ours, stock = assert_like_stock(name, lambda: moving("rigl", update_on="rollout"))
    assert_networks_alike(ours, stock)
    assert ours.policy.sparse.networks[-1].mask_updates > 1


@pytest.mark.parametrize("storage", ["masked", "sparse"])
def test_targets_that_keep_their_connections_until_the_next_copy(storage):
    kwargs = dict(policy_kwargs_of("set", storage), optimizer_kwargs=dict(eps=1e-2))
    assert_like_stock(
        "DQN", lambda: moving("set", update_interval=5), 70, policy_kwargs=kwargs,
        learning_rate=0.02, target_update_interval=4,
    )  # fmt: skip


WRONG = [
    ("SAC", {}, dict(gamma=0.98)),
    ("SAC", {}, dict(tau=0.006)),
    ("SAC", dict(ent_coef=0.1), dict(ent_coef=0.0)),
    ("SAC", {}, dict(target_entropy=-2.9)),
    ("SAC", dict(gradient_steps=3), dict(target_update_interval=2)),
    ("SAC", {}, dict(learning_rate=3.1e-4)),
    ("TD3", {}, dict(gamma=0.98)),
    ("TD3", {}, dict(tau=0.006)),
    ("TD3", {}, dict(policy_delay=3)),
    ("TD3", {}, dict(target_policy_noise=0.19)),
    ("DQN", {}, dict(gamma=0.98)),
    ("DQN", {}, dict(max_grad_norm=0.1)),
    ("DQN", {}, dict(target_update_interval=11)),
    ("TQC", {}, dict(top_quantiles_to_drop_per_net=1)),
    ("QRDQN", {}, dict(max_grad_norm=0.1)),
    ("CrossQ", {}, dict(gamma=0.98)),
    ("CrossQ", {}, dict(policy_delay=3)),
    ("CrossQ", {}, dict(target_entropy=-2.9)),
    ("CrossQ", {}, dict(learning_rate=3.1e-4)),
    ("PPO", dict(ent_coef=1e-3), dict(ent_coef=0.0)),
    ("PPO", {}, dict(vf_coef=0.51)),
    ("PPO", {}, dict(clip_range=0.01)),
    ("PPO", {}, dict(max_grad_norm=0.4)),
    ("PPO", {}, dict(normalize_advantage=False)),
    ("A2C", dict(ent_coef=1e-3), dict(ent_coef=0.0)),
    ("A2C", {}, dict(vf_coef=0.51)),
    ("A2C", {}, dict(rms_prop_eps=2e-5)),
]


@pytest.mark.parametrize(("name", "common", "wrong"), WRONG)
def test_the_comparison_notices_a_wrong_setting(name, common, wrong):
    stock = learn(make(STOCK, name, **common))
    ours = learn(make(sb3_sparse, name, **{**common, **wrong}))
    with pytest.raises(AssertionError):
        assert_alike(ours, stock)
