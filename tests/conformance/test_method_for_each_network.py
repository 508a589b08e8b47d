"""A method for each network, on every algorithm that has an actor and a critic."""

from __future__ import annotations

import numpy as np
import pytest
from support import ALGORITHMS, assert_masked, make

from sb3_sparse import SparsityCallback

STEPS = 96
TWO = sorted(
    name
    for name, algorithm in ALGORITHMS.items()
    if set(algorithm.policy_aliases["SparsePolicy"].networks) == {"actor", "critic"}
)
STORAGES = ("masked", "sparse")


def trained(name, storage, method, policy_kwargs=None, **options):
    kwargs = {"compute": storage, "sparsity": 0.7, **(policy_kwargs or {})}
    model = make(name, policy_kwargs=kwargs)
    model.before = masks_of(model)
    model.learn(STEPS, callback=SparsityCallback(method, **options))
    assert_masked(model)
    return model


def networks_of(model):
    actor, critic = model.policy.sparse.networks
    assert (actor.name, critic.name) == ("actor", "critic")
    return actor, critic


def masks_of(model):
    return {
        network.name: np.concatenate([layer.mask() for layer in network.layers])
        for network in networks_of(model)
    }


def weights_of(model):
    return {name: value.numpy().copy() for name, value in model.policy.state_dict().items()}


def test_eight_algorithms_have_two_networks():
    assert TWO == ["A2C", "CrossQ", "DDPG", "PPO", "SAC", "TD3", "TQC", "TRPO"]


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("name", TWO)
def test_the_same_method_named_for_both_is_that_method_bit_for_bit(name, storage):
    one = trained(name, storage, "rigl", update_interval=5, drop_fraction=0.3)
    both = {"actor": "rigl", "critic": "rigl"}
    two = trained(name, storage, both, update_interval={"critic": 5, "actor": 5}, drop_fraction=0.3)
    assert any(network.mask_updates for network in networks_of(one))
    ours, theirs = weights_of(one), weights_of(two)
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        np.testing.assert_array_equal(value, theirs[key], err_msg=key)


def clocks(name, storage):
    """Gradient steps that each network takes."""
    return {n.name: n.clock for n in networks_of(trained(name, storage, "static"))}


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("name", TWO)
def test_a_static_actor_keeps_its_mask_and_the_critic_moves_as_beside_a_moving_one(name, storage):
    # One update: until then both runs are the same, and critics are updated before their actors.
    interval = clocks(name, storage)["critic"] * 2 // 3
    options = dict(update_interval=interval, drop_fraction=0.3, end=1.0)
    mixed = trained(name, storage, {"critic": "rigl"}, **options)
    both = trained(name, storage, "rigl", **options)
    actor, critic = networks_of(mixed)
    assert (actor.mask_updates, critic.mask_updates) == (0, 1)
    np.testing.assert_array_equal(masks_of(mixed)["actor"], mixed.before["actor"])
    assert (masks_of(mixed)["critic"] != mixed.before["critic"]).any()
    np.testing.assert_array_equal(masks_of(mixed)["critic"], masks_of(both)["critic"])


@pytest.mark.parametrize("name", TWO)
def test_options_of_a_network_are_its_own(name):
    steps = clocks(name, "masked")
    model = trained(
        name,
        "masked",
        {"actor": "set", "critic": "rigl"},
        update_interval={"actor": 3, "critic": 4},
        drop_fraction={"actor": 0.4},
        end=1.0,
    )
    actor, critic = networks_of(model)
    assert (actor.clock, critic.clock) == (steps["actor"], steps["critic"])
    # The last environment step, or the last rollout, comes at progress 1, where nothing moves.
    at_end = {"PPO": 20, "A2C": 1, "TRPO": 20}.get(name, 1)
    for network, interval in ((actor, 3), (critic, 4)):
        due = [step for step in range(interval, network.clock + 1, interval)]
        assert network.updates_due in (
            len(due),
            sum(step <= network.clock - at_end for step in due),
        )
        assert network.mask_updates > 0


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("name", TWO)
def test_a_pruned_critic_ends_exact_beside_an_actor_that_starts_where_it_ends(name, storage):
    start = {"initial_sparsity": {"critic": 0.35}}
    model = trained(name, storage, {"critic": "granet"}, start, update_interval=4)
    actor, critic = networks_of(model)
    np.testing.assert_array_equal(masks_of(model)["actor"], model.before["actor"])
    assert model.before["critic"].sum() > critic.nnz
    for layer in (*actor.layers, *critic.layers):
        assert layer.nnz == layer.final_nnz, layer.name
