"""A method for each network, on every algorithm that has an actor and a critic."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from support import ALGORITHMS, assert_masked, make

from sb3_sparse import SparsityCallback

ON_POLICY = ("A2C", "PPO", "TRPO")
TWO = sorted(
    name
    for name, algorithm in ALGORITHMS.items()
    if set(algorithm.policy_aliases["SparsePolicy"].networks) == {"actor", "critic"}
)
STORAGES = ("masked", "sparse")


def steps_of(name):
    """Three rollouts, or forty gradient steps."""
    return 96 if name in ON_POLICY else 60


def trained(name, storage, method, policy_kwargs=None, **options):
    kwargs = {"compute": storage, "sparsity": 0.7, **(policy_kwargs or {})}
    model = make(name, policy_kwargs=kwargs)
    model.before = masks_of(model)
    model.learn(steps_of(name), callback=SparsityCallback(method, **options))
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


@cache
def steps_of_critic(name):
    """Gradient steps that the critic takes."""
    _, critic = networks_of(trained(name, "masked", "static"))
    return critic.clock


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("name", TWO)
def test_a_static_actor_keeps_its_mask_and_the_critic_moves_as_beside_a_moving_one(name, storage):
    # One update: until then both runs are the same, and critics are updated before their actors.
    interval = steps_of_critic(name) * 2 // 3
    options = dict(update_interval=interval, drop_fraction=0.3, end=1.0)
    mixed = trained(name, storage, {"critic": "rigl"}, **options)
    both = trained(name, storage, "rigl", **options)
    actor, critic = networks_of(mixed)
    assert (actor.mask_updates, critic.mask_updates) == (0, 1)
    np.testing.assert_array_equal(masks_of(mixed)["actor"], mixed.before["actor"])
    assert (masks_of(mixed)["critic"] != mixed.before["critic"]).any()
    np.testing.assert_array_equal(masks_of(mixed)["critic"], masks_of(both)["critic"])


class Progress(SparsityCallback):
    """Notes the progress of training at each gradient step of each network."""

    def _on_training_start(self):
        super()._on_training_start()
        self.at = {"actor": [], "critic": []}

    def _on_rollout_start(self):
        self._note_steps()
        super()._on_rollout_start()

    def _on_training_end(self):
        self._note_steps()
        super()._on_training_end()

    def _note_steps(self):
        for network in networks_of(self.model):
            at = self.at[network.name]
            at += [self.model.num_timesteps / self.model._total_timesteps] * (
                network.clock - len(at)
            )


@pytest.mark.parametrize("name", TWO)
def test_options_of_a_network_are_its_own(name):
    callback = Progress(
        {"actor": "set", "critic": "rigl"},
        update_interval={"actor": 3, "critic": 4},
        drop_fraction={"actor": 0.4},
        end={"actor": 1.0, "critic": 0.7},
    )
    model = make(name, policy_kwargs={"compute": "masked", "sparsity": 0.7})
    model.learn(steps_of(name), callback=callback)
    actor, critic = networks_of(model)
    for network, interval, end in ((actor, 3, 1.0), (critic, 4, 0.7)):
        at = callback.at[network.name]
        assert len(at) == network.clock
        due = sum(progress < end for progress in at[interval - 1 :: interval])
        assert (network.updates_due, network.mask_updates > 0) == (due, due > 0)


class Rollouts(SparsityCallback):
    """Keeps the masks before and after what happens when rollouts begin."""

    def _on_training_start(self):
        super()._on_training_start()
        self.before, self.after = [], []

    def _on_rollout_start(self):
        self.before.append(masks_of(self.model))
        super()._on_rollout_start()
        self.after.append(masks_of(self.model))


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("waits", ["actor", "critic"])
def test_networks_update_at_the_step_or_at_the_rollout_each_for_itself(waits, storage):
    moves = {"actor": "critic", "critic": "actor"}[waits]
    callback = Rollouts(
        {"actor": "rigl", "critic": "granet"},
        update_interval=4,
        update_on={waits: "rollout"},
        end=0.9,
    )
    kwargs = {"compute": storage, "sparsity": 0.7, "initial_sparsity": {"critic": 0.35}}
    model = make("PPO", policy_kwargs=kwargs)
    model.learn(steps_of("PPO"), callback=callback)
    assert_masked(model)
    starts = list(zip(callback.after, callback.before[1:], callback.after[1:], strict=False))
    assert len(starts) == 2  # the rollouts after the first
    for last, before, after in starts:
        np.testing.assert_array_equal(before[waits], last[waits])  # not in gradient steps
        assert (after[waits] != before[waits]).any()
        assert (before[moves] != last[moves]).any()
        np.testing.assert_array_equal(after[moves], before[moves])
    for network in networks_of(model):
        for layer in network.layers:
            assert layer.nnz == layer.final_nnz, layer.name


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
