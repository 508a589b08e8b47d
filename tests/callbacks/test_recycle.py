"""Dormant units get new incoming weights, and nothing else changes."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize
from support import TinyDicts, TinyImages, assert_masked, make

import sb3_sparse
from sb3_sparse import RecycleDormantCallback, SparsityCallback
from sb3_sparse.analysis.activity import activity
from sb3_sparse.analysis.wiring import wiring_of
from sb3_sparse.callbacks.recycle import recycle
from sb3_sparse.errors import ConfigError
from sb3_sparse.networks import ImpalaCNN
from sb3_sparse.sparsity.initialisation import glorot_limits

OFF_POLICY = ["DQN", "SAC", "TD3", "DDPG", "TQC", "QRDQN", "CrossQ"]
STORAGES = ["masked", "sparse"]


def tensors_of(model):
    state = {k: v for k, v in model.policy.state_dict().items() if isinstance(v, th.Tensor)}
    for number, optimizer in enumerate(model.policy.sparse.optimizers):
        for place, values in optimizer.state_dict()["state"].items():
            for key, value in values.items():
                state[f"optimizer {number} {place} {key}"] = th.as_tensor(value)
    return {name: value.clone() for name, value in state.items()}


def one_that_never_fires(storage="masked", **kwargs):
    """DQN of widths 6 and 5 whose third unit of the first layer is always 0."""
    policy_kwargs = {"net_arch": [6, 5], "sparsity": 0.5, "compute": storage, **kwargs}
    model = make("DQN", policy_kwargs=policy_kwargs, learning_starts=5, batch_size=8)
    model.learn(40)
    first = model.policy.q_net.q_net[0]
    with th.no_grad():
        first.bias[2] = -1e6
    return model


@pytest.mark.parametrize("storage", STORAGES)
def test_a_unit_that_never_fires_by_hand(storage):
    model = one_that_never_fires(storage)
    callback = RecycleDormantCallback(tau=0.0)
    callback.init_callback(model)
    before, layers = tensors_of(model), list(model.policy.sparse.layers)
    masks = [layer.mask().reshape(layer.shape) for layer in layers]
    other = copy.deepcopy(model.policy)
    numpy_state, torch_state = np.random.get_state()[1].copy(), th.get_rng_state()
    observations = model.replay_buffer.observations[:40, 0]
    with th.no_grad():
        first, activation, third, *_ = other.q_net.q_net
        hidden = activation(first(th.as_tensor(observations)))
    never = (hidden == 0).all(dim=0)
    assert never[2]
    callback.act(1000)
    after = tensors_of(model)
    assert (np.random.get_state()[1] == numpy_state).all()
    assert th.equal(th.get_rng_state(), torch_state)
    assert all(
        (layer.mask().reshape(layer.shape) == mask).all()
        for layer, mask in zip(layers, masks, strict=True)
    )
    assert_masked(model)
    weight, old = after["q_net.q_net.0.weight"], before["q_net.q_net.0.weight"]
    limits = th.from_numpy(np.broadcast_to(glorot_limits(masks[0]), (6, 4)).copy())
    active = th.from_numpy(masks[0][2])
    assert active.any()
    assert (weight[2] != old[2])[active].all()
    assert (weight[2].abs() <= limits[2])[active].all()
    assert not weight[2][~active].any()
    assert after["q_net.q_net.0.bias"][2] == 0
    second = after["q_net.q_net.2.weight"]
    assert not second[:, 2].any()
    kept = ~never
    assert th.equal(weight[kept], old[kept])
    # Units of the second layer may be dormant, too; rows of those that are not stay.
    with th.no_grad():
        again = activation(third(hidden))
    rows = ~(again == 0).all(dim=0)
    assert th.equal(second[rows][:, kept], before["q_net.q_net.2.weight"][rows][:, kept])
    # Adam's moments of the same weights, in the order of parameters: weight, bias, weight, ...
    for key in ("exp_avg", "exp_avg_sq"):
        assert not after[f"optimizer 0 0 {key}"][2].any()
        assert not after[f"optimizer 0 1 {key}"][2].any()
        assert not after[f"optimizer 0 2 {key}"][:, 2].any()
        name = f"optimizer 0 0 {key}"
        assert th.equal(after[name][kept], before[name][kept])
    assert after["optimizer 0 0 step"] == before["optimizer 0 0 step"] > 0
    for name, value in before.items():
        if "target" in name:
            assert th.equal(after[name], value), name
    assert model.logger.name_to_value["redo/dormant/q_net"] == pytest.approx(
        float((never.sum() + (~rows).sum()) / 11)
    )


def test_a_unit_just_at_the_threshold_is_dormant():
    model = make("DQN", policy_kwargs={"net_arch": [4], "sparsity": 0.0, "dense_layers": []})
    first, last = model.policy.q_net.q_net[0], model.policy.q_net.q_net[2]
    with th.no_grad():
        first.weight.zero_()
        first.bias.copy_(th.tensor([4.0, 3.0, 0.5, 0.5]))  # mean 2: the last two are at a quarter
    model.set_logger(configure(None, []))
    model.replay_buffer.add(*[np.zeros((1, 4))] * 2, np.zeros((1, 1)), *np.zeros((2, 1)), [{}])
    for tau, recycled in ((0.24, []), (0.25, [2, 3])):
        twin = copy.deepcopy(last.weight)
        callback = RecycleDormantCallback(tau=tau)
        callback.init_callback(model)
        callback.act(1)
        zeros = (last.weight == 0).all(dim=0).nonzero().ravel().tolist()
        assert zeros == recycled
        assert th.equal(last.weight[:, :2], twin[:, :2])
        assert first.bias.tolist() == ([4.0, 3.0, 0.5, 0.5] if not recycled else [4.0, 3.0, 0, 0])


@pytest.mark.parametrize("storage", STORAGES)
def test_weights_are_those_of_the_layers_own_initialisation(storage):
    model = one_that_never_fires(storage, sparsity_aware_init=False)
    wiring = wiring_of(model.policy, model.replay_buffer.observations[0])
    which = {"q_net.q_net.1": np.arange(6) == 2}
    recycle(model.policy, wiring, which, 7)
    once = tensors_of(model)
    row = once["q_net.q_net.0.weight"][2]
    assert (row.abs() <= 0.5).all()  # of nn.Linear: 1 / sqrt(4)
    recycle(model.policy, wiring, which, 7)
    assert all(th.equal(value, once[name]) for name, value in tensors_of(model).items())
    recycle(model.policy, wiring, which, 8)
    assert not th.equal(tensors_of(model)["q_net.q_net.0.weight"][2], row)


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("name", OFF_POLICY)
def test_every_algorithm_recycles_and_trains_on(name, storage):
    if name == "CrossQ" and storage == "sparse":
        storage = "auto"
    model = make(name, policy_kwargs={"compute": storage})
    callback = RecycleDormantCallback(5, tau=0.8, batch_size=32)  # many count as dormant
    model.learn(60, callback=[SparsityCallback("rigl", update_interval=4), callback])
    networks = [network.name for network in model.policy.sparse.networks]
    shares = [model.logger.name_to_value[f"redo/dormant/{network}"] for network in networks]
    assert all(0 < share < 1 for share in shares)
    assert_masked(model)
    assert all(th.isfinite(value).all() for value in tensors_of(model).values())


@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN"])
def test_fused_steps_go_on_from_recycled_units(name):
    models = []
    for library in (sb3_sparse, stable_baselines3):
        model = make(getattr(library, name), learning_starts=10)
        callback = RecycleDormantCallback(7, tau=0.3, batch_size=32)
        model.learn(40, callback=[SparsityCallback("rigl", update_interval=9), callback])
        models.append(model)
    ours, stock = models
    assert ours.why_not_fused() is None
    one, two = tensors_of(ours), tensors_of(stock)
    assert one.keys() == two.keys()
    for key, value in one.items():
        th.testing.assert_close(
            value, two[key], rtol=1e-3, atol=3e-5, msg=lambda m, key=key: f"{key}: {m}"
        )


def test_it_acts_when_gradient_steps_pass_a_multiple_and_at_the_end():
    acted = []

    class Watch(RecycleDormantCallback):
        def act(self, step):
            acted.append(step)

    model = make("SAC", learning_starts=10, train_freq=4, gradient_steps=3)
    model.learn(42, callback=Watch(10))  # nine rounds of 3 gradient steps
    assert acted == [12, 21]
    model = make("SAC", learning_starts=10)
    acted.clear()
    model.learn(30, callback=Watch(10))
    assert acted == [10, 20]
    model.learn(10, callback=Watch(10), reset_num_timesteps=False)
    assert acted == [10, 20, 30]


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("env", [TinyImages, TinyDicts])
def test_channels_are_units_and_what_reads_them_through_other_modules_is_found(env, compute):
    policy = {TinyImages: "SparseCnnPolicy", TinyDicts: "SparseMultiInputPolicy"}[env]
    model = stable_baselines3.SAC(
        policy,
        env(discrete=False),
        buffer_size=50,
        learning_starts=5,
        policy_kwargs={"sparsity": 0.8, "net_arch": [16], "compute": compute},
    )
    model.learn(10, callback=RecycleDormantCallback(2, tau=0.5, batch_size=8))
    assert_masked(model)
    wiring = wiring_of(model.policy, model.get_env().reset())
    (last,) = [w for n, w in wiring.items() if n.startswith("critic.f") and "linear" in n]
    assert set(last.outgoing) == {"critic.qf0.0", "critic.qf1.0"}
    (units,) = {tuple(units.tolist()) for units in last.outgoing.values()}
    extra = len(units) - last.units  # the vector, and two actions
    assert extra == {TinyImages: 2, TinyDicts: 7}[env]
    assert [unit for unit in units if unit >= 0] == list(range(last.units))
    cnn = [w for n, w in wiring.items() if n.startswith("critic.f") and "cnn" in n]
    assert [w.units for w in cnn] == [32, 64, 64]


def test_streams_of_a_residual_network_are_left_alone():
    kwargs = dict(features_extractor_class=ImpalaCNN, sparsity=0.5, net_arch=[])
    kwargs["features_extractor_kwargs"] = dict(channels=(4, 4, 4), features_dim=8)
    model = stable_baselines3.DQN(
        "SparseCnnPolicy", TinyImages(), buffer_size=20, policy_kwargs=kwargs
    )
    wiring = wiring_of(model.policy, model.get_env().reset())
    found = {one.incoming.removeprefix("q_net.features_extractor.") for one in wiring.values()}
    blocks = {f"cnn.{place}.layers.1" for place in (2, 3, 6, 7, 10, 11)}
    assert found == {*blocks, "linear.0"}  # between two convolutions of a block, and the last


def test_outputs_are_no_units():
    model = make("TD3")
    wiring = wiring_of(model.policy, model.get_env().reset())
    assert "actor.mu.4" not in {one.incoming for one in wiring.values()}  # before the tanh
    assert len(wiring) == 6


@pytest.mark.parametrize("n_steps", [1, 3])
def test_batches_are_normalised_observations_of_the_replay_buffer(n_steps, monkeypatch):
    env = VecNormalize(make_vec_env("Pendulum-v1", 2))
    model = make("SAC", env, learning_starts=10, n_steps=n_steps)
    seen = []

    def watched(model, observations, actions):
        seen.append(observations.numpy())
        return activity(model, observations, actions)

    monkeypatch.setattr("sb3_sparse.callbacks.recycle.activity", watched)
    callback = RecycleDormantCallback(1000, batch_size=64)
    model.learn(60, callback=callback)
    assert not seen
    callback.act(1000)
    stored = model.replay_buffer.observations[:30].reshape(60, 3)
    allowed = env.normalize_obs(stored)
    (batch,) = seen
    assert batch.shape == (64, 3)
    apart = np.abs(batch[:, None] - allowed).max(axis=2)
    assert apart.min(axis=1).max() < 1e-6
    assert np.abs(batch[:, None] - stored).max(axis=2).min() > 1e-3  # none as it is stored


def test_other_policies_and_values_are_refused():
    model = stable_baselines3.SAC("MlpPolicy", "Pendulum-v1")
    with pytest.raises(ConfigError, match="RecycleDormantCallback needs a sparse policy .with"):
        model.learn(1, callback=RecycleDormantCallback())
    with pytest.raises(ConfigError, match="with a replay buffer, such as DQN, .* got PPO"):
        make("PPO").learn(1, callback=RecycleDormantCallback())
    for kwargs, said in (
        ({"interval": 0}, "interval must be a whole number, 1 or more, got 0"),
        ({"batch_size": 0.5}, "batch_size must be a whole number, 1 or more, got 0.5"),
        ({"tau": -1}, "tau must be a number, 0 or more, got -1"),
    ):
        with pytest.raises(ConfigError, match=said):
            RecycleDormantCallback(**kwargs)


def test_contrib_is_there():
    assert set(OFF_POLICY) <= {*dir(stable_baselines3), *dir(sb3_contrib)}


def test_a_training_shorter_than_the_interval_is_told_so():
    model = make("SAC", learning_starts=10)
    with pytest.warns(UserWarning, match="reached no multiple of 1000, the interval"):
        model.learn(30, callback=RecycleDormantCallback())
