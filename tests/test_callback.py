"""The callback inside real training."""

from __future__ import annotations

import csv
import inspect
from contextlib import nullcontext

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EveryNTimesteps
from stable_baselines3.common.logger import configure
from support import assert_masked, make, registered

from sb3_sparse import SparsityCallback
from sb3_sparse.engine import products
from sb3_sparse.errors import ConfigError
from sb3_sparse.topology import DropGrow


@pytest.fixture
def gradient_spy():
    """RigL that keeps the dense gradients it was handed, by layer."""
    seen: dict[str, list[np.ndarray]] = {}

    class Spy(DropGrow):
        name = "spy"
        needs_gradient = True

        def scores(self, layer, update, candidates, *, dense_grad):
            seen.setdefault(layer.name, []).append(dense_grad.copy())
            return np.abs(dense_grad[candidates])

    with registered(Spy):
        yield seen


def raw_gradients(model) -> dict[str, list[np.ndarray]]:
    """Every gradient that reaches a sparse weight in any backward pass, before all masks."""
    seen: dict[str, list[np.ndarray]] = {}
    for layer in model.policy.sparse.layers:

        def note(grad: th.Tensor, name: str = layer.name) -> None:
            seen.setdefault(name, []).append(grad.detach().numpy().ravel().copy())

        layer.weight.register_hook(note)
    model.policy.sparse._gradient_hooks.remove()  # ours come after those above
    model.policy.sparse.attach()
    return seen


@pytest.mark.parametrize("name", ["SAC", "TQC", "CrossQ"])
def test_the_critics_grow_by_their_own_losss_gradient_bit_for_bit(name, gradient_spy, monkeypatch):
    # A critic that does not skip them gets gradients of the actor's loss too.
    monkeypatch.setattr("sb3_sparse.policies.critics._frozen", lambda critic: nullcontext())
    model = make(name, policy_delay=1) if name == "CrossQ" else make(name)
    raw = raw_gradients(model)
    # learning_starts=20 and training at every step: 40 steps are 20 gradient steps.
    model.learn(40, callback=SparsityCallback("spy", update_interval=4))
    critic = model.policy.sparse.networks[1]
    moving = [layer for layer in critic.layers if layer.nnz < layer.size]
    assert moving
    contaminated = 0
    for layer in moving:
        # Backward passes alternate: critic loss, actor loss.
        steps = raw[layer.name]
        assert len(steps) == 2 * critic.clock
        updates = gradient_spy[layer.name]
        assert updates
        for k, dense_grad in enumerate(updates, start=1):
            step = 4 * k - 1
            np.testing.assert_array_equal(dense_grad, steps[2 * step])
            contaminated += (dense_grad != steps[2 * step + 1]).any()
    assert contaminated > 0


@pytest.mark.parametrize("name", ["DQN", "PPO"])
def test_a_single_loss_is_handed_over_bit_for_bit(name, gradient_spy):
    model = make(name)
    raw = raw_gradients(model)
    model.learn(64, callback=SparsityCallback("spy", update_interval=4))
    for layer_name, updates in gradient_spy.items():
        for k, dense_grad in enumerate(updates, start=1):
            np.testing.assert_array_equal(dense_grad, raw[layer_name][4 * k - 1])


@pytest.mark.parametrize(("method", "dense"), [("rigl", True), ("set", True), ("static", False)])
@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO", "TRPO"])
def test_sparse_layers_compute_dense_gradients_for_updates_only(name, method, dense, monkeypatch):
    computed = []
    outer = products._outer
    monkeypatch.setattr(products, "_outer", lambda *args: computed.append(0) or outer(*args))
    model = make(name, policy_kwargs=dict(compute="sparse"))
    options = {} if method == "static" else {"update_interval": 6}
    model.learn(64, callback=SparsityCallback(method, **options))
    due = {
        network.name: sum(6 * k <= network.clock for k in range(1, 99))
        for network in model.policy.sparse.networks
    }
    layers = {network.name: len(network.layers) for network in model.policy.sparse.networks}
    assert (len(computed) > 0) == dense
    assert len(computed) <= sum(due[network] * layers[network] for network in due)


def test_trpos_actor_grows_by_the_gradient_of_its_objective(gradient_spy):
    model = make("TRPO", n_critic_updates=4)
    objective: dict[str, list[np.ndarray]] = {}
    compute = model._compute_actor_grad

    def spied(kl_div, policy_objective):
        for layer in model.policy.sparse.networks[0].layers:
            with th.enable_grad():
                masked = [p for p in layer.module.parameters()]
                layer.weight._backward_hooks, hooks = None, layer.weight._backward_hooks
                (grad, *_) = th.autograd.grad(policy_objective, masked, retain_graph=True)
                layer.weight._backward_hooks = hooks
            objective.setdefault(layer.name, []).append(grad.numpy().ravel().copy())
        for layer in model.policy.sparse.layers:
            if layer.gradient_mask is not None:
                layer.gradient_mask.dense_grad = None
        return compute(kl_div, policy_objective)

    model._compute_actor_grad = spied
    # Two rollouts of 32; 8 critic steps each: one update a rollout.
    model.learn(64, callback=SparsityCallback("spy", update_interval=8, end=1.0))
    actor = [layer for layer in model.policy.sparse.networks[0].layers if layer.nnz < layer.size]
    for layer in actor:
        (first, *_) = gradient_spy[layer.name]
        np.testing.assert_array_equal(first, objective[layer.name][0])


@pytest.mark.parametrize("name", ["PPO", "DQN", "A2C"])
def test_the_norm_that_sb3_clips_is_that_of_active_weights(name, monkeypatch):
    model = make(name)
    raw = raw_gradients(model)
    masks = {layer.name: layer.mask() for layer in model.policy.sparse.layers}
    clip = th.nn.utils.clip_grad_norm_
    checked = []

    def spied(parameters, max_norm, **kwargs):
        parameters = list(parameters)
        sparse_weights = {id(layer.weight): layer.name for layer in model.policy.sparse.layers}
        squares = dense_squares = 0.0
        for parameter in parameters:
            if parameter.grad is None:
                continue
            if id(parameter) in sparse_weights:
                layer_name = sparse_weights[id(parameter)]
                gradient = raw[layer_name][-1].astype(np.float64)
                squares += (gradient[masks[layer_name]] ** 2).sum()
                dense_squares += (gradient**2).sum()
            else:
                squares += float((parameter.grad.double() ** 2).sum())
                dense_squares += float((parameter.grad.double() ** 2).sum())
        norm = clip(parameters, max_norm, **kwargs)
        assert float(norm) == pytest.approx(squares**0.5, rel=1e-4)
        checked.append((squares, dense_squares))
        return norm

    monkeypatch.setattr(th.nn.utils, "clip_grad_norm_", spied)
    model.learn(64)
    assert checked
    assert any(dense > 1.05 * active for active, dense in checked)


def test_pruning_follows_the_cubic_ramp_and_ends_exact():
    model = make("SAC", policy_kwargs=dict(initial_sparsity=0.0))
    seen = {}

    class Note(BaseCallback):
        def _on_step(self) -> bool:
            critic = model.policy.sparse.networks[1]
            seen[self.num_timesteps] = (critic.nnz, critic.size)
            return True

    prune = SparsityCallback("prune", update_interval=1)
    model.learn(200, callback=[prune, Note()])
    # The move of step t shows at the callback of step t + 1; begin at 40, end at 160 of 200.
    assert seen[40][0] == seen[40][1] == 1392
    middle = 0
    for layer in model.policy.sparse.networks[1].layers:
        middle += layer.size - int((1 - 0.5**3) * (layer.size - layer.final_nnz) + 1e-6)
    assert seen[101][0] == middle
    assert seen[161][0] == sum(layer.final_nnz for layer in model.policy.sparse.networks[1].layers)
    assert_masked(model)


def test_a_longer_run_after_pruning_does_not_bring_connections_back():
    model = make("SAC", policy_kwargs=dict(initial_sparsity=0.0))
    model.learn(120, callback=SparsityCallback("prune", update_interval=2))
    masks = [layer.mask() for layer in model.policy.sparse.layers]
    for reset in (False, True):
        model.learn(
            60, callback=SparsityCallback("prune", update_interval=2), reset_num_timesteps=reset
        )
        for layer, mask in zip(model.policy.sparse.layers, masks, strict=True):
            np.testing.assert_array_equal(layer.mask(), mask)


def test_on_rollout_masks_stand_still_while_ppo_learns_and_move_between_rollouts(monkeypatch):
    model = make("PPO")
    changed = []
    train = model.train

    def spied():
        before = [layer.mask() for layer in model.policy.sparse.layers]
        train()
        after = [layer.mask() for layer in model.policy.sparse.layers]
        changed.append(any((a != b).any() for a, b in zip(before, after, strict=True)))

    monkeypatch.setattr(model, "train", spied)
    callback = SparsityCallback("rigl", update_interval=5, update_on="rollout")
    start = [layer.mask() for layer in model.policy.sparse.layers]
    model.learn(128, callback=callback)
    assert changed == [False] * 4
    end = [layer.mask() for layer in model.policy.sparse.layers]
    assert any((a != b).any() for a, b in zip(start, end, strict=True))
    assert_masked(model)


def test_what_is_logged(tmp_path):
    model = make("SAC", policy_kwargs=dict(sparsity=dict(actor=0.5, critic=0.9)))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(600, log_interval=1, callback=SparsityCallback("set", update_interval=100))
    with (tmp_path / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    last = rows[-1]
    # Actor 72 + 576 + 48 = 696 connections, critics 2 x 696.
    actor, critic = model.policy.sparse.networks
    assert float(last["sparsity/actor"]) == pytest.approx(1 - actor.nnz / 696)
    assert float(last["sparsity/critic"]) == pytest.approx(1 - critic.nnz / 1392)
    assert int(last["sparsity/nnz"]) == actor.nnz + critic.nnz
    assert float(last["sparsity/total"]) == pytest.approx(1 - (actor.nnz + critic.nnz) / 2088)
    assert int(last["sparsity/mask_updates"]) == 4  # steps 100..400 of those before 80 %
    assert 0 < float(last["sparsity/mask_churn"]) < 0.5
    assert float(last["sparsity/drop_fraction"]) <= 0.5


def test_two_callbacks_at_once_are_refused_and_an_interrupted_run_can_go_on():
    model = make("SAC")
    with pytest.raises(ConfigError, match="two SparsityCallbacks"):
        model.learn(30, callback=[SparsityCallback("set"), SparsityCallback("rigl")])
    model.learn(30, callback=SparsityCallback("set"))
    assert not model.policy.sparse.has_plans


def test_after_an_interrupted_run_masks_stand_still_without_a_callback():
    class Interrupt(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 40:
                raise KeyboardInterrupt
            return True

    model = make("SAC")
    with pytest.raises(KeyboardInterrupt):
        model.learn(400, callback=[SparsityCallback("rigl", update_interval=2), Interrupt()])
    masks = [layer.mask() for layer in model.policy.sparse.layers]
    model.learn(40)
    for layer, mask in zip(model.policy.sparse.layers, masks, strict=True):
        np.testing.assert_array_equal(layer.mask(), mask)


def test_a_pruned_model_can_go_on_with_any_method():
    model = make("SAC", policy_kwargs=dict(initial_sparsity=0.0))
    model.learn(60, callback=SparsityCallback("prune", update_interval=2))
    nnz = [layer.nnz for layer in model.policy.sparse.layers]
    for method in ("static", "rigl", "prune"):
        options = {} if method == "static" else dict(update_interval=2)
        model.learn(40, callback=SparsityCallback(method, **options))
        assert [layer.nnz for layer in model.policy.sparse.layers] == nnz


def test_training_too_short_for_an_update_says_so():
    with pytest.warns(
        UserWarning,
        match=r"no mask update.*every 1000th.*0% and 80%.*actor: 20 steps",
    ):
        make("SAC").learn(40, callback=SparsityCallback("set"))


def test_a_second_training_without_an_update_says_so_too():
    model = make("SAC").learn(40, callback=SparsityCallback("set", update_interval=2))
    assert model.policy.sparse.networks[0].mask_updates > 0
    with pytest.warns(UserWarning, match="no mask update.*actor: 20 steps"):
        model.learn(40, callback=SparsityCallback("set"))


def test_training_on_after_the_last_update_says_nothing(recwarn):
    model = make("SAC").learn(40, callback=SparsityCallback("set", update_interval=2))
    model.learn(5, callback=SparsityCallback("set"), reset_num_timesteps=False)
    assert not recwarn.list


def test_a_network_without_an_update_is_named():
    model = make("TD3")
    with pytest.warns(UserWarning, match=r"no mask update of actor, so .*\(actor: 10 steps\)"):
        model.learn(40, callback=SparsityCallback("set", update_interval=12, end=1.0))
    assert model.policy.sparse.networks[1].mask_updates > 0


def test_a_resumed_training_counts_the_updates_before_it(recwarn):
    model = make("SAC").learn(40, callback=SparsityCallback("set", update_interval=2, end=1.0))
    assert model.policy.sparse.networks[0].mask_updates > 0
    model.learn(10, callback=SparsityCallback("set", end=1.0), reset_num_timesteps=False)
    assert not recwarn.list


def test_help_shows_the_defaults_and_a_method_leaves_alone_what_it_does_not_take():
    shown = str(inspect.signature(SparsityCallback))
    for default in (
        "update_interval: 'int | Mapping[str, int]' = 1000",
        "drop_fraction: 'float | Mapping[str, float]' = 0.5",
        "= 0.8",
    ):
        assert default in shown
    assert '0.2 for ``"prune"``' in (SparsityCallback.__doc__ or "")
    assert SparsityCallback("prune").plans["net"].begin == 0.2
    assert SparsityCallback("rigl").plans["net"].begin == 0.0
    assert SparsityCallback("prune", begin=0.0).plans["net"].begin == 0.0


def test_learning_for_no_steps_is_allowed_as_in_sb3():
    make("PPO").learn(0, callback=SparsityCallback("static"))


def test_a_child_of_an_event_callback_moves_masks_too():
    """Such a child gets no rollout and no training-end calls."""
    model = make("SAC", policy_kwargs=dict(initial_sparsity=0.0))
    child = SparsityCallback("prune", update_interval=1)
    model.learn(100, callback=EveryNTimesteps(n_steps=1, callback=child))
    for layer in model.policy.sparse.layers:
        assert layer.nnz == layer.final_nnz


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("riggle", {}, "unknown method 'riggle'.*; allowed are"),
        (
            "static",
            dict(update_interval=10),
            "'static' has no update_interval; it takes no options",
        ),
        ("prune", dict(drop_fraction=0.3), "'prune' has no drop_fraction; it takes begin, end"),
        ("set", dict(drop_fraction=2.0), "drop_fraction must lie in"),
        ("rigl", dict(update_on="episode"), "one of step, rollout"),
    ],
)
def test_wrong_arguments_are_named_with_what_is_allowed(method, options, message):
    with pytest.raises(ConfigError, match=message):
        SparsityCallback(method, **options)


def test_a_policy_that_is_not_sparse_is_refused():
    model = make("SAC", policy="MlpPolicy")
    with pytest.raises(ConfigError, match="needs a sparse policy, got SACPolicy"):
        model.learn(10, callback=SparsityCallback("set"))


def test_pruning_needs_a_denser_start_and_other_methods_must_not_have_one():
    with pytest.raises(ConfigError, match="initial_sparsity=0.0 in policy_kwargs"):
        make("SAC").learn(10, callback=SparsityCallback("prune"))
    model = make("SAC", policy_kwargs=dict(initial_sparsity=0.0))
    with pytest.raises(ConfigError, match="give a sparsity above 0"):
        make("SAC", policy_kwargs=dict(sparsity=0.0, initial_sparsity=0.0)).learn(
            10, callback=SparsityCallback("prune")
        )
    with pytest.raises(ConfigError, match="would never take it to its sparsity"):
        model.learn(10, callback=SparsityCallback("rigl"))


def test_an_optimizer_that_is_not_adam_works_too():
    for optimizer in (th.optim.SGD, th.optim.RMSprop, th.optim.AdamW):
        model = make("DQN", policy_kwargs=dict(optimizer_class=optimizer))
        model.learn(80, callback=SparsityCallback("rigl", update_interval=5))
        assert model.policy.sparse.networks[0].mask_updates > 0
        assert_masked(model)
