"""Targets of a mask that moves."""

from __future__ import annotations

import numpy as np
from support import make

from sb3_sparse.engine.plan import Plan
from sb3_sparse.engine.plans import Plans


def move_everything(model, soft: bool) -> None:
    """One SET update of all networks, with no gradient step."""
    sparse = model.policy.sparse
    plans = Plans(Plan("set", 1, 0.5, 0.0, 0.8, "step"))
    sparse.start(plans, soft_targets=soft, in_force=lambda: True)
    for network in sparse.networks:
        sparse._move(network, {})
    sparse.stop()


def test_soft_targets_follow_at_once_dropped_to_zero_and_grown_from_zero():
    model = make("SAC")
    model.learn(40)
    critic = model.policy.sparse.networks[1]
    before = {
        layer.name: (layer.mask(), layer.targets[0].weight.clone()) for layer in critic.layers
    }
    move_everything(model, soft=True)
    moved = 0
    for layer in critic.layers:
        old_mask, old_target = before[layer.name]
        target = layer.targets[0].weight.detach().numpy().ravel()
        dropped, grown = old_mask & ~layer.mask(), ~old_mask & layer.mask()
        kept = old_mask & layer.mask()
        assert not target[dropped].any()
        assert not target[grown].any()
        np.testing.assert_array_equal(target[kept], old_target.detach().numpy().ravel()[kept])
        moved += dropped.sum()
    assert moved > 0


def test_hard_targets_keep_their_snapshot_until_the_next_copy():
    model = make("DQN", target_update_interval=10_000)
    model.learn(40)
    (network,) = model.policy.sparse.networks
    snapshot = [layer.targets[0].weight.clone() for layer in network.layers]
    move_everything(model, soft=False)
    for layer, weights in zip(network.layers, snapshot, strict=True):
        assert (layer.targets[0].weight == weights).all()
    model.target_update_interval = 1
    model._on_step()
    for layer in network.layers:
        assert (layer.targets[0].weight == layer.weight).all()


def test_the_callback_tells_soft_from_hard_by_tau():
    from sb3_sparse import SparsityCallback

    for name, kwargs, soft in (("SAC", {}, True), ("DQN", {}, False), ("DQN", {"tau": 0.1}, True)):
        model = make(name, **kwargs)
        model.learn(30, callback=SparsityCallback("set", update_interval=5))
        assert model.policy.sparse.soft_targets is soft


def test_a_targets_state_can_be_loaded_from_the_network_as_sb3_does():
    model = make("SAC")
    model.critic_target.load_state_dict(model.critic.state_dict())
    model = make("DQN")
    model.q_net_target.load_state_dict(model.q_net.state_dict())
