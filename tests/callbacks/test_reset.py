"""Periodic resets: new weights under the old masks, and an empty optimizer."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch as th
from stable_baselines3.common.logger import configure
from support import assert_masked, make

import sb3_sparse
from sb3_sparse import ResetCallback, SparsityCallback
from sb3_sparse.errors import ConfigError
from sb3_sparse.sparsity.initialisation import glorot_limits

OFF_POLICY = ["DQN", "SAC", "TD3", "DDPG", "TQC", "QRDQN", "CrossQ"]


def trained(name, **policy_kwargs):
    model = make(name, policy_kwargs=policy_kwargs)
    model.learn(60, callback=SparsityCallback("rigl", update_interval=4))
    return model


def acting(model, **kwargs):
    model.set_logger(configure(None, []))
    callback = ResetCallback(10, **kwargs)
    callback.init_callback(model)
    return callback


def state_of(model):
    return {
        name: value.clone()
        for name, value in model.policy.state_dict().items()
        if isinstance(value, th.Tensor)
    }


@pytest.mark.parametrize("compute", ["masked", "auto"])
@pytest.mark.parametrize("name", OFF_POLICY)
def test_everything_is_drawn_anew_but_masks_and_clocks(name, compute):
    model = trained(name, compute=compute)
    sparse = model.policy.sparse
    masks = [layer.mask() for layer in sparse.layers]
    clocks = [network.clock for network in sparse.networks]
    before, size = state_of(model), model.replay_buffer.size()
    numpy_state, torch_state = np.random.get_state()[1].copy(), th.get_rng_state()
    acting(model).act(1000)
    assert (np.random.get_state()[1] == numpy_state).all()
    assert th.equal(th.get_rng_state(), torch_state)
    assert all((x.mask() == y).all() for x, y in zip(sparse.layers, masks, strict=True))
    assert [network.clock for network in sparse.networks] == clocks
    assert model.replay_buffer.size() == size
    assert_masked(model)
    after = state_of(model)
    for layer in sparse.layers:
        mask = layer.mask().reshape(layer.shape)
        new, old = (state[f"{layer.name}.weight"].numpy() for state in (after, before))
        assert (new != old)[mask].mean() > 0.9
        limits = np.broadcast_to(glorot_limits(mask), layer.shape)
        assert (np.abs(new)[mask] <= limits[mask]).all()
        assert np.abs(new)[mask].max() > 0.5 * limits[mask].min()
    assert not any(optimizer.state for optimizer in sparse.optimizers)
    for key, value in after.items():  # the statistics of CrossQ
        fresh = {"ra_mean": 0, "ra_var": 1, "steps": 0}.get(key.rpartition(".")[2])
        assert fresh is None or (value == fresh).all(), key
    assert name != "CrossQ" or sum(key.endswith("ra_mean") for key in after) == 9
    for spec in model.policy.networks.values():
        if spec.target is None:
            continue
        for key, value in after.items():
            if key.startswith(f"{spec.target}.") and not key.endswith("mask"):
                online = key.replace(f"{spec.target}.", f"{spec.roots[0]}.", 1)
                assert th.equal(value, after[online]), key
    model.learn(40, reset_num_timesteps=False)
    assert_masked(model)


def test_without_sparsity_aware_initialisation_weights_are_sb3s():
    model = trained("TD3", sparsity_aware_init=False)
    acting(model).act(3)
    for layer in model.policy.sparse.layers:
        bound = 1 / np.sqrt(layer.shape[1])  # of nn.Linear
        found = np.abs(layer.dense()[layer.mask()])
        assert found.max() <= bound
        assert found.max() > 0.5 * bound
    once = state_of(model)
    acting(model).act(3)
    assert all(th.equal(value, once[key]) for key, value in state_of(model).items())
    acting(model).act(4)
    assert not th.equal(state_of(model)["actor.mu.0.weight"], once["actor.mu.0.weight"])


def test_a_dense_network_is_drawn_as_by_sb3():
    model = make("SAC", policy_kwargs={"sparsity": 0.0})
    acting(model).act(3)
    weight = model.policy.actor.latent_pi[0].weight
    assert weight.abs().max() <= 1 / np.sqrt(3)


@pytest.mark.parametrize("compute", ["masked", "auto"])
def test_named_layers_alone_are_reset(compute):
    model = trained("SAC", compute=compute)
    before = state_of(model)
    counts = [len(optimizer.state) for optimizer in model.policy.sparse.optimizers]
    acting(model, layers=["output", "actor.latent_pi.2"]).act(1000)
    after = state_of(model)
    changed = {
        key.rpartition(".")[0]
        for key in before
        if not th.equal(before[key], after[key]) and "target" not in key
    }
    expected = {"actor.mu", "actor.log_std", "actor.latent_pi.2", "critic.qf0.4", "critic.qf1.4"}
    assert changed == expected
    left = [len(optimizer.state) for optimizer in model.policy.sparse.optimizers]
    assert [x - y for x, y in zip(counts, left, strict=True)] == [6, 4]  # weights and biases
    assert th.equal(after["critic_target.qf0.0.weight"], after["critic.qf0.0.weight"])
    model.learn(20, reset_num_timesteps=False)
    assert_masked(model)


@pytest.mark.parametrize("layers", [None, ["output"]], ids=["all", "output"])
@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN"])
def test_fused_steps_go_on_from_a_reset(name, layers):
    models = []
    for library in (sb3_sparse, stable_baselines3):
        model = make(getattr(library, name), learning_starts=10)
        callback = ResetCallback(9, layers=layers)
        model.learn(35, callback=[SparsityCallback("rigl", update_interval=7), callback])
        models.append(model)
    ours, stock = models
    assert ours.why_not_fused() is None
    assert stock.logger.name_to_value["reset/count"] == 2
    one, two = state_of(ours), state_of(stock)
    for key, value in one.items():
        th.testing.assert_close(
            value, two[key], rtol=1e-3, atol=3e-5, msg=lambda m, key=key: f"{key}: {m}"
        )


@pytest.mark.parametrize(
    ("kwargs", "steps", "due"),
    [
        ({"gradient_steps": 1}, 30, [10, 20]),
        ({"gradient_steps": 3}, 17, [12, 21]),  # the second is due in the last round of 7
        ({"gradient_steps": -1, "train_freq": 4}, 28, [12, 20]),
        ({"gradient_steps": -1, "train_freq": (1, "episode")}, 40, [20, 40]),
    ],
)
def test_a_resumed_training_resets_as_the_uninterrupted_one(kwargs, steps, due, tmp_path):
    acted = []

    class Watch(ResetCallback):
        def act(self, step):
            super().act(step)
            acted.append((step, self.model.policy.actor.latent_pi[0].weight.detach().clone()))

    env = gym.make("Pendulum-v1", max_episode_steps=20)
    model = make("SAC", env, learning_starts=10, **kwargs)
    model.learn(2 * steps, callback=Watch(10))
    whole, acted = acted[:2], []
    assert [step for step, _ in whole] == due
    model = make("SAC", env, learning_starts=10, **kwargs)
    model.learn(steps, callback=Watch(10))  # none after the last step, where the second is due
    assert [step for step, _ in acted] == due[:1]
    model.save(tmp_path / "model.zip")
    again = stable_baselines3.SAC.load(tmp_path / "model.zip", model.get_env())
    again.replay_buffer = model.replay_buffer
    again.learn(1, callback=Watch(10), reset_num_timesteps=False)
    assert [step for step, _ in acted] == due
    for (_, one), (_, two) in zip(whole, acted, strict=True):
        assert th.equal(one, two)


def test_steps_without_the_callback_make_no_reset_due():
    acted = []

    class Watch(ResetCallback):
        def act(self, step):
            acted.append(step)

    model = make("SAC", learning_starts=10)
    model.learn(30)  # 20 gradient steps
    model.learn(5, callback=Watch(10), reset_num_timesteps=False)
    assert acted == []
    model.learn(6, callback=Watch(10), reset_num_timesteps=False)
    assert acted == [30]


def test_what_is_not_allowed_is_refused():
    with pytest.raises(ConfigError, match="layers has 'outputs', which matches no layer"):
        make("SAC").learn(1, callback=ResetCallback(layers=["outputs"]))
    with pytest.raises(ConfigError, match="ResetCallback needs a sparse policy"):
        stable_baselines3.SAC("MlpPolicy", "Pendulum-v1").learn(1, callback=ResetCallback())
    with pytest.raises(ConfigError, match="with a replay buffer, such as DQN, .* got A2C"):
        make("A2C").learn(1, callback=ResetCallback())
    for layers in ("output", [3]):
        with pytest.raises(ConfigError, match="must be a list of names, such as"):
            ResetCallback(layers=layers)
    with pytest.raises(ConfigError, match="layers must name one at least"):
        ResetCallback(layers=[])
