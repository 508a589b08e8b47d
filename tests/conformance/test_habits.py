"""Habits of SB3's users that write to networks by ways of their own, in every storage."""

from __future__ import annotations

import copy
import warnings

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from support import ALGORITHMS, DISCRETE, assert_masked, make
from torch import nn
from torch.nn.utils import prune  # noqa: F401

from sb3_sparse import SparsityCallback
from sb3_sparse.errors import ConfigError, CorruptStateError, UnsupportedError

NAMES = sorted(ALGORITHMS)
PARTS = {"SAC": "actor", "TD3": "actor", "TQC": "actor", "DQN": "q_net", "QRDQN": "quantile_net",
         "CrossQ": "actor", "DDPG": "actor"}  # fmt: skip
"""Critics alone cannot be loaded in SB3 either: their constructor's arguments are not saved."""


def inactive(model) -> float:
    """Largest magnitude of a weight that no mask has, in what a file would hold."""
    return max(
        float(np.abs(layer.dense()[~layer.mask()]).max(initial=0.0))
        for layer in model.policy.sparse.layers
    )


def behaviour_cloning(model, optimizer, steps: int = 3) -> None:
    """Regression on the sum of what all networks give for random input."""
    random = th.Generator().manual_seed(0)
    for _ in range(steps):
        optimizer.zero_grad()
        loss = th.zeros(())
        for layer in model.policy.sparse.layers:
            x = th.randn(8, layer.shape[1], generator=random)
            loss = loss + (layer.module(x) - 1.0).square().mean()
        loss.backward()
        optimizer.step()


class Langevin(th.optim.SGD):
    def step(self, closure=None):
        super().step(closure)
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.data.add_(th.randn_like(parameter), alpha=1e-2)


def noise_on_parameters(model):
    for parameter in model.policy.parameters():
        parameter.data.add_(th.randn_like(parameter), alpha=0.1)


def reset_parameters(model):
    for layer in model.policy.sparse.layers:
        layer.module.reset_parameters()


def drawn_anew(model):
    model.policy.apply(
        lambda module: nn.init.orthogonal_(module.weight) if isinstance(module, nn.Linear) else None
    )


def langevin(model):
    behaviour_cloning(model, Langevin(model.policy.parameters(), lr=1e-2))


WRITERS = [noise_on_parameters, reset_parameters, drawn_anew, langevin]


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("name", NAMES)
def test_whoever_writes_what_is_inactive_is_zero_when_it_counts(name, write, tmp_path):
    model = make(name)
    observation = model.observation_space.sample()
    before = [layer.dense().copy() for layer in model.policy.sparse.layers]
    write(model)
    assert any(
        (layer.dense() != old).any()
        for layer, old in zip(model.policy.sparse.layers, before, strict=True)
    )
    acted, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    loaded = ALGORITHMS[name].load(tmp_path / "model", env=model.get_env())
    np.testing.assert_array_equal(loaded.predict(observation, deterministic=True)[0], acted)
    assert inactive(loaded) == 0.0
    write(model)
    model.learn(30, callback=SparsityCallback("set", update_interval=2))
    assert_masked(model)
    write(model)
    model.policy.sparsity_report()
    assert inactive(model) == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_averaged_weights_copied_back_after_a_move_are_masked(name, storage):
    model = make(name)
    layer = next(iter(model.policy.sparse.layers))
    averaged = th.ones(layer.shape)  # of connections that have come and gone
    if storage == "masked":
        layer.weight.data.copy_(averaged)
    else:
        layer.weight.data.copy_(averaged.reshape(-1)[layer.mask()])
    model.policy.set_training_mode(True)  # as every train() begins
    np.testing.assert_array_equal(layer.dense(), layer.mask().astype(np.float32))


@pytest.mark.parametrize(
    "optimizer", [th.optim.Adam, lambda p, lr: th.optim.SGD(p, lr, momentum=0.9)]
)
@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_an_optimizer_of_the_users_own_keeps_each_connections_momentum(name, optimizer):
    model = make(name)
    own = optimizer(model.policy.parameters(), lr=1e-2)
    behaviour_cloning(model, own)
    layers = list(model.policy.sparse.layers)

    def remembered() -> list[dict[str, np.ndarray]]:
        return [
            {
                key: layer.saved_moment(value).detach().numpy().ravel().copy()
                for key, value in own.state[layer.weight].items()
                if isinstance(value, th.Tensor) and value.dim()
            }
            for layer in layers
        ]

    before, masks = remembered(), [layer.mask() for layer in layers]
    sparse = model.policy.sparse
    sparse.start(SparsityCallback("set", update_interval=1).plans, True, lambda: True)
    for network in sparse.networks:
        sparse._move(network, {})
    sparse.stop()
    for parameter in model.policy.parameters():
        parameter.grad = th.zeros_like(parameter)
    for group in own.param_groups:
        group["lr"] = 0.0
    own.step()
    decay = {"exp_avg": 0.9, "exp_avg_sq": 0.999, "momentum_buffer": 0.9}
    for layer, old, mask, new in zip(layers, before, masks, remembered(), strict=True):
        kept = mask & layer.mask()
        for key, value in new.items():
            np.testing.assert_allclose(value[kept], decay[key] * old[key][kept], rtol=1e-5)
            assert not value[layer.mask() & ~mask].any()
            assert not value[~layer.mask()].any()
    assert inactive(model) == 0.0


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_an_optimizer_whose_memory_cannot_follow_says_so(name, storage):
    model = make(name)
    layer = next(layer for layer in model.policy.sparse.networks[0].layers if not layer.full)
    own = th.optim.SGD([layer.weight], lr=0.1)
    layer.weight.grad = th.ones_like(layer.weight)
    own.step()
    own.state[layer.weight]["rows"] = th.zeros(3)
    own.step()  # nothing has moved
    sparse = model.policy.sparse
    sparse.start(SparsityCallback("set", update_interval=1).plans, True, lambda: True)
    sparse._move(sparse.networks[0], {})
    if storage == "sparse":
        with pytest.raises(UnsupportedError, match=r"SGD remembers 'rows' of shape \(3,\)"):
            own.step()
    else:
        own.step()


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"TRPO"}))
def test_optimizers_that_need_matrices_keep_masks(name):
    kwargs = dict(optimizer_class=th.optim.Adafactor, compute="auto")
    model = make(name, policy_kwargs=kwargs)
    model.learn(48, callback=SparsityCallback("rigl", update_interval=4))
    assert not any(layer.is_sparse for layer in model.policy.sparse.layers)
    assert inactive(model) == 0.0
    with pytest.raises(UnsupportedError, match="Adafactor"):
        make(name, policy_kwargs=dict(kwargs, compute="sparse"))


def test_noisy_optimizers_leave_what_is_inactive_at_zero():
    model = make("SAC", policy_kwargs=dict(optimizer_class=Langevin, compute="masked"))
    model.learn(40)
    assert inactive(model) == 0.0


@pytest.mark.parametrize(
    ("name", "env"), [*((name, None) for name in NAMES), ("DQN", "TinyImages-v0")]
)
def test_vectors_are_dense_in_every_storage(name, env, storage):
    model = make(name, env)
    vector = model.policy.parameters_to_vector()
    dense = make(name, env, policy="CnnPolicy" if env else "MlpPolicy")
    assert vector.shape == dense.policy.parameters_to_vector().shape
    other = {"masked": "sparse", "sparse": "masked"}[storage]
    twin = make(name, env, policy_kwargs=dict(compute=other), seed=1)
    twin.policy.load_state_dict(model.policy.state_dict())
    twin.policy.load_from_vector(2 * vector)
    np.testing.assert_array_equal(twin.policy.parameters_to_vector(), 2 * vector)


@pytest.mark.parametrize("name", NAMES)
def test_a_vector_of_another_mask_or_length_is_no_silent_mixture(name):
    model, other = make(name, seed=0), make(name, seed=1)
    mine, theirs = (m.policy.parameters_to_vector() for m in (model, other))
    with pytest.warns(UserWarning, match="belong to inactive connections and were dropped"):
        model.policy.load_from_vector(theirs)
    for layer, source in zip(model.policy.sparse.layers, other.policy.sparse.layers, strict=True):
        np.testing.assert_array_equal(layer.dense(), source.dense() * layer.mask())
    model.policy.load_from_vector(mine)
    for wrong in (mine[:-1], np.append(mine, 0.0), mine.reshape(1, -1)):
        with pytest.raises(ConfigError, match=rf"takes \({mine.size},\)"):
            model.policy.load_from_vector(wrong)
    np.testing.assert_array_equal(model.policy.parameters_to_vector(), mine)


def test_evolution_strategies_on_vectors_work_as_with_a_dense_policy():
    model = make("DQN")
    best = model.policy.parameters_to_vector()
    random = np.random.default_rng(0)
    for _ in range(3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model.policy.load_from_vector(best + 0.1 * random.standard_normal(best.size))
        model.predict(model.observation_space.sample())
        best = model.policy.parameters_to_vector()
        assert inactive(model) == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_evolution_strategies_on_the_floats_of_a_state_dict_work(name):
    model = make(name)
    state = model.policy.state_dict()
    floats = {k: v + 0.1 for k, v in state.items() if v.is_floating_point()}
    model.policy.load_state_dict(floats, strict=False)
    for layer in model.policy.sparse.layers:
        wanted = floats[f"{layer.name}.weight"].numpy().ravel() * layer.mask()
        np.testing.assert_array_equal(layer.dense(), wanted)
    assert_masked(model)


@pytest.mark.parametrize("name", sorted(PARTS))
def test_a_part_is_saved_for_sb3s_own_class_and_acts_the_same(name, tmp_path):
    model = make(name).learn(30)
    part = getattr(model.policy, PARTS[name])
    stock = next(c for c in type(part).__mro__ if not c.__module__.startswith("sb3_sparse"))
    part.save(tmp_path / "part.pth")
    loaded = stock.load(tmp_path / "part.pth", device="cpu")
    assert type(loaded) is stock
    assert not any("mask" in key for key in loaded.state_dict())
    batch = th.as_tensor(np.stack([model.observation_space.sample() for _ in range(5)]))
    actions = [p.predict(batch.numpy(), deterministic=True)[0] for p in (part, loaded)]
    np.testing.assert_allclose(actions[0], actions[1], rtol=1e-4, atol=1e-5)
    model.learn(30, callback=SparsityCallback("set", update_interval=2))  # it still trains
    assert_masked(model)


@pytest.mark.parametrize("name", ["SAC", "TD3", "TQC", "DQN", "QRDQN", "CrossQ"])
def test_a_part_with_other_masks_is_taken_and_its_target_follows(name):
    model, other = make(name, seed=0), make(name, seed=1)
    part = {"DQN": "q_net", "QRDQN": "quantile_net"}.get(name, "critic")
    getattr(model.policy, part).load_state_dict(getattr(other.policy, part).state_dict())
    for network in model.policy.sparse.networks:
        for layer in network.layers:
            for target in layer.targets:
                weight = target.state_dict()["weight"].reshape(-1)
                if network.name == part:
                    assert not weight[~layer.mask()].any()
    model.learn(200 if name in DISCRETE else 40)
    largest = max(float(p.abs().max()) for p in model.policy.parameters())
    assert largest < 100.0
    assert_masked(model)


@pytest.mark.parametrize("name", NAMES)
def test_parameters_without_exact_match_take_what_is_there(name):
    model, other = make(name, seed=0), make(name, seed=1)
    parameters = other.get_parameters()
    optimizers = [key for key in parameters if key != "policy"]
    model.set_parameters({"policy": parameters["policy"]}, exact_match=False)
    assert optimizers
    for layer, source in zip(model.policy.sparse.layers, other.policy.sparse.layers, strict=True):
        np.testing.assert_array_equal(layer.mask(), source.mask())
        np.testing.assert_array_equal(layer.dense(), source.dense())
    model.learn(40, callback=SparsityCallback("set", update_interval=2))
    assert_masked(model)


@pytest.mark.parametrize("name", NAMES)
def test_a_strict_load_misses_masks_and_weights_alike(name):
    model = make(name)
    state = model.policy.state_dict()
    layer = next(iter(model.policy.sparse.layers)).name
    for key in (f"{layer}.weight_mask", f"{layer}.weight"):
        with pytest.raises(RuntimeError, match=f"Missing key.*{key}"):
            model.policy.load_state_dict({k: v for k, v in state.items() if k != key})


class LowersTau(BaseCallback):
    """Turns hard copies into soft ones in mid-run, and clamps all parameters now and then."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 100:
            self.model.tau = 0.1
        if self.num_timesteps % 35 == 0:
            for parameter in self.model.policy.parameters():
                parameter.data.clamp_(-1.0, 1.0)
        return True


@pytest.mark.parametrize("name", ["DQN", "QRDQN"])
def test_targets_stay_sound_when_tau_falls_or_parameters_are_clamped(name):
    model = make(name, target_update_interval=7)
    model.learn(200, callback=[SparsityCallback("rigl", update_interval=5), LowersTau()])
    for parameter in model.policy.parameters():
        assert float(parameter.abs().max()) < 100.0
    assert_masked(model)


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"TRPO"}))  # fails in sb3-contrib as well
def test_layers_frozen_after_construction_stay_as_they_are(name):
    model = make(name)
    frozen = [layer for network in model.policy.sparse.networks for layer in network.layers[:1]]
    for layer in frozen:
        layer.weight.requires_grad_(False)
    before = [(layer.dense().copy(), layer.mask()) for layer in frozen]
    copy.deepcopy(model.policy)
    model.learn(40, callback=SparsityCallback("set", update_interval=2))
    for layer, (weights, mask) in zip(frozen, before, strict=True):
        np.testing.assert_array_equal(layer.mask(), mask)
        np.testing.assert_array_equal(layer.dense(), weights)
    for layer in frozen:
        layer.weight.requires_grad_(True)
    model.learn(40, callback=SparsityCallback("set", update_interval=2))
    assert_masked(model)
    for layer, (weights, _) in zip(frozen, before, strict=True):
        assert (layer.dense() != weights).any()


def test_layers_unfrozen_within_a_round_are_masked_at_the_next_step():
    model = make("SAC")
    layer = model.policy.sparse.networks[0].layers[1]
    layer.weight.requires_grad_(False)
    model.policy.set_training_mode(True)
    layer.weight.requires_grad_(True)
    layer.module(th.ones(2, layer.shape[1])).sum().backward()
    model.actor.optimizer.step()
    assert inactive(model) == 0.0


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_a_layer_that_was_replaced_is_rejected_by_name(name):
    model = make(name)
    layer = list(model.policy.sparse.layers)[-1]
    parent, _, child = layer.name.rpartition(".")
    new = nn.Linear(layer.shape[1], layer.shape[0])
    setattr(model.policy.get_submodule(parent), child, new)
    with pytest.raises(UnsupportedError, match=rf"{layer.name} was replaced"):
        model.learn(60)
    with pytest.raises(UnsupportedError, match=rf"{layer.name} was replaced"):
        model.policy.sparsity_report()


def test_a_denser_start_without_a_callback_is_no_secret():
    model = make("SAC", policy_kwargs=dict(initial_sparsity=0.0))
    either = r"SparsityCallback\('granet'\) or SparsityCallback\('prune'\)"
    with pytest.warns(UserWarning, match=f"denser than requested.*{either}"):
        model.learn(40)


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_predicting_and_saving_leave_a_living_graph_alone(name):
    model = make(name)
    x = th.as_tensor(np.stack([model.observation_space.sample() for _ in range(5)]))
    acting = {"SAC": "actor", "DQN": "q_net"}.get(name)
    y = model.policy.predict_values(x) if acting is None else getattr(model.policy, acting)(x)
    model.predict(x.numpy())
    model.policy.state_dict()
    y.sum().backward()


@pytest.mark.parametrize("name", sorted(PARTS))
def test_a_part_acts_as_the_policy_whoever_wrote_its_weights(name):
    model = make(name)
    observation = model.observation_space.sample()
    noise_on_parameters(model)
    alone, _ = getattr(model.policy, PARTS[name]).predict(observation, deterministic=True)
    whole, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(alone, whole)


@pytest.mark.parametrize("name", sorted(PARTS))
def test_a_copy_of_a_part_stays_sparse_while_it_is_trained(name, tmp_path):
    model = make(name)
    part = copy.deepcopy(getattr(model.policy, PARTS[name]))
    optimizer = th.optim.Adam(part.parameters(), lr=0.05)
    x = th.as_tensor(np.stack([model.observation_space.sample() for _ in range(5)]))
    for _ in range(3):
        optimizer.zero_grad()
        given = part(x)
        sum(y.square().sum() for y in (given if isinstance(given, tuple) else (given,))).backward()
        optimizer.step()
    prefix = f"{PARTS[name]}."
    for layer in model.policy.sparse.layers:
        if layer.name.startswith(prefix):
            module = part.get_submodule(layer.name.removeprefix(prefix))
            weight = module.state_dict()["weight"].numpy().ravel()
            assert not weight[~layer.mask()].any()
    part.save(tmp_path / "part.pth")


@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN", "PPO"])
def test_noise_is_gone_from_what_is_saved_at_once(name):
    model = make(name)
    noise_on_parameters(model)
    state = model.policy.state_dict()
    for layer in model.policy.sparse.layers:
        assert not state[f"{layer.name}.weight"].reshape(-1)[~layer.mask()].any()
        for target in layer.targets:
            weight = target.state_dict()["weight"]
            assert int(weight.count_nonzero()) <= layer.nnz


def test_noise_is_gone_from_a_part_that_is_saved_at_once(tmp_path):
    model = make("SAC")
    noise_on_parameters(model)
    model.actor.save(tmp_path / "actor.pth")
    saved = th.load(tmp_path / "actor.pth", weights_only=False)["state_dict"]
    for layer in model.policy.sparse.networks[0].layers:
        weight = saved[layer.name.removeprefix("actor.") + ".weight"].reshape(-1)
        assert not weight[~layer.mask()].any()


@pytest.mark.parametrize("name", ["SAC", "DQN"])
def test_masks_of_another_sparsity_are_rejected_by_a_part_and_by_load(name, tmp_path):
    model, other = make(name), make(name, policy_kwargs=dict(sparsity=0.8))
    part = PARTS[name]
    with pytest.raises(CorruptStateError, match="a policy of this sparsity has"):
        getattr(model.policy, part).load_state_dict(getattr(other.policy, part).state_dict())
    model.save(tmp_path / "model")
    kwargs = {**model.policy_kwargs, "sparsity": 0.8}
    with pytest.raises(CorruptStateError, match="a policy of this sparsity has"):
        ALGORITHMS[name].load(tmp_path / "model", custom_objects={"policy_kwargs": kwargs})


def test_gradients_that_others_wrote_move_nothing_inactive():
    model = make("PPO")
    for parameter in model.policy.parameters():
        parameter.grad = th.ones_like(parameter)
    model.policy.optimizer.step()
    for layer in model.policy.sparse.layers:
        assert not layer.dense()[~layer.mask()].any()
        for value in model.policy.optimizer.state[layer.weight].values():
            if value.dim():
                moment = layer.saved_moment(value).reshape(-1)
                assert not moment[~layer.mask()].any()


def test_parameters_that_join_an_optimizer_of_the_users_own_are_followed():
    model = make("SAC")
    layers = list(model.policy.sparse.layers)
    own = Langevin([layers[0].weight], lr=0.0)
    layers[0].weight.grad = th.ones_like(layers[0].weight)
    own.step()
    own.param_groups[0]["params"] = [layers[1].weight]
    layers[1].weight.grad = th.ones_like(layers[1].weight)
    own.step()
    assert inactive(model) == 0.0
    own.add_param_group({"params": [layers[4].weight]})
    layers[4].weight.grad = th.ones_like(layers[4].weight)
    own.step()
    assert inactive(model) == 0.0


@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_lbfgs_is_rejected_once_sparse_masks_have_moved(name, storage):
    model = make(name)
    own = th.optim.LBFGS(model.policy.parameters(), lr=1e-3, max_iter=1)
    parameters = list(model.policy.parameters())

    def closure():
        own.zero_grad()
        loss = sum(parameter.square().sum() for parameter in parameters)
        loss.backward()
        return loss

    own.step(closure)
    sparse = model.policy.sparse
    sparse.start(SparsityCallback("set", update_interval=1).plans, True, lambda: True)
    for network in sparse.networks:
        sparse._move(network, {})
    if storage == "sparse":
        with pytest.raises(UnsupportedError, match="LBFGS does not move each weight by itself"):
            own.step(closure)
    else:
        own.step(closure)
        assert inactive(model) == 0.0


def test_many_gradients_at_once_are_those_one_by_one():
    model = make("SAC")
    x = th.randn(2, 3, requires_grad=True)
    y = model.actor(x, deterministic=True).sum(dim=1)
    many = th.autograd.grad(y, x, th.eye(2), is_grads_batched=True, retain_graph=True)[0]
    for i in range(2):
        (one,) = th.autograd.grad(y[i], x, retain_graph=True)
        np.testing.assert_allclose(many[i], one, rtol=1e-5, atol=1e-6)


def test_a_mask_that_torchs_own_pruning_took_away_is_missed():
    model = make("PPO", policy_kwargs=dict(compute="masked"))
    th.nn.utils.prune.l1_unstructured(model.policy.action_net, "weight", 0.3)
    th.nn.utils.prune.remove(model.policy.action_net, "weight")
    with pytest.raises(UnsupportedError, match="the mask of action_net was taken away"):
        model.predict(model.observation_space.sample())


def test_two_backward_passes_before_a_step_add_up_for_rigl():
    grown = []
    for compute in ("masked", "sparse"):
        model = make("SAC", policy_kwargs=dict(compute=compute))
        sparse = model.policy.sparse
        sparse.start(SparsityCallback("rigl", update_interval=1).plans, True, lambda: True)
        random = th.Generator().manual_seed(0)
        for _ in range(2):
            model.actor(th.randn(6, 3, generator=random), deterministic=True).sum().backward()
        model.actor.optimizer.step()
        grown.append([layer.mask() for layer in sparse.networks[0].layers])
        weights = [layer.dense().copy() for layer in sparse.networks[0].layers]
        grown.append(weights)
    for one, other in zip(grown[1], grown[3], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_drawing_anew_keeps_gradients():
    model = make("SAC")
    model.actor(th.randn(6, 3), deterministic=True).sum().backward()
    before = [layer.weight.grad.clone() for layer in model.policy.sparse.networks[0].layers[:2]]
    drawn_anew(model)
    for layer, grad in zip(model.policy.sparse.networks[0].layers, before, strict=False):
        assert th.equal(layer.weight.grad, grad)


def test_a_target_keeps_the_connections_of_its_network_whatever_masks_it_is_given():
    model, other = make("DQN", seed=0), make("DQN", seed=1)
    model.q_net_target.load_state_dict(other.q_net.state_dict())
    model.learn(60)  # the next copy needs the online connections
    assert_masked(model)
    for ours, target in zip(model.q_net.parameters(), model.q_net_target.parameters(), strict=True):
        assert ours.shape == target.shape


@pytest.mark.parametrize("name", ["DQN", "SAC"])
def test_a_target_never_has_more_connections_than_its_network(name):
    model, dense = make(name), make(name, policy="MlpPolicy")
    part, target = ("q_net", "q_net_target") if name == "DQN" else ("critic", "critic_target")

    def check() -> None:
        for layer in model.policy.sparse.layers:
            for module in layer.targets:
                assert int(module.state_dict()["weight"].count_nonzero()) <= layer.nnz

    getattr(model, target).load_state_dict(getattr(dense, part).state_dict())
    check()
    with pytest.warns(UserWarning, match="were dropped"):
        model.policy.load_from_vector(np.ones(model.policy.parameters_to_vector().size))
    check()
    model.learn(40)
    check()
