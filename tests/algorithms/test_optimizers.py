"""Optimizers of every kind, and whoever watches them."""

from __future__ import annotations

import pytest
import torch as th
from algorithms_support import (
    STOCK,
    assert_alike,
    assert_like_stock,
    fused,
    learn,
    make,
    moving,
    optimizers_of,
)
from torch.optim.optimizer import register_optimizer_step_post_hook

import sb3_sparse

LIBRARIES = (sb3_sparse, STOCK)


class OwnAdam(th.optim.Adam):
    """Of the user's own."""

    def step(self, closure=None):
        super().step(closure)
        super().step(closure)


KINDS = [
    (th.optim.SGD, dict()),
    (th.optim.SGD, dict(momentum=0.9, nesterov=True, weight_decay=0.01)),
    (th.optim.RMSprop, dict(centered=True)),
    (th.optim.Adagrad, dict()),
    (th.optim.Adam, dict(amsgrad=True)),
    (th.optim.Adam, dict(weight_decay=0.01, betas=(0.7, 0.9), eps=1e-3)),
    (th.optim.Adam, dict(maximize=True)),
    (th.optim.Adam, dict(foreach=True)),
    (th.optim.AdamW, dict(weight_decay=0.1)),
    (th.optim.AdamW, dict(amsgrad=True)),
    (OwnAdam, dict()),
]


@pytest.mark.parametrize(("kind", "settings"), KINDS)
@pytest.mark.parametrize("name", ["SAC", "PPO"])
def test_a_kind_of_optimizer(name, kind, settings):
    kwargs = dict(optimizer_class=kind, optimizer_kwargs=dict(settings), compute="masked")
    method = "set" if kind in (th.optim.Adam, th.optim.AdamW, th.optim.SGD) else "static"
    assert_like_stock(name, lambda: moving(method, update_interval=4), policy_kwargs=kwargs)


@pytest.mark.parametrize(("kind", "settings"), KINDS[4:6])
def test_sparse_layers(kind, settings):
    kwargs = dict(optimizer_class=kind, optimizer_kwargs=dict(settings), compute="sparse")
    assert_like_stock("SAC", lambda: moving("rigl"), policy_kwargs=kwargs)


def train_both(change, name="SAC", **kwargs):
    models = []
    for library in LIBRARIES:
        model = make(library, name, **kwargs)
        models.append((model, change(model)))
        learn(model)
    (ours, one), (stock, two) = models
    assert fused(ours)
    assert_alike(ours, stock)
    return one, two


def owner(model):
    return getattr(model.policy, "critic", model.policy).optimizer


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO"])
def test_several_groups_with_rates_of_their_own(name):
    def split(model):
        optimizer = owner(model)
        group = optimizer.param_groups[0]
        moved = group["params"][-2:]
        del group["params"][-2:]
        optimizer.add_param_group(dict(params=moved, weight_decay=0.1, eps=1e-3, betas=(0.5, 0.9)))

    train_both(split, name)


@pytest.mark.parametrize("name", ["SAC", "A2C"])
def test_a_scheduler_around_the_steps(name):
    def schedule(model):
        return th.optim.lr_scheduler.LambdaLR(owner(model), lambda epoch: 1.0)

    one, two = train_both(schedule, name)
    assert one.optimizer._opt_called
    assert two.optimizer._opt_called


def test_somebody_who_wraps_a_step():
    def wrap(model):
        optimizer, calls = owner(model), []
        step = optimizer.step

        def wrapped(*args, **kwargs):
            calls.append(1)
            for group in optimizer.param_groups:
                for parameter in group["params"]:
                    parameter.grad.mul_(0.5)
            return step(*args, **kwargs)

        optimizer.step = wrapped
        return calls

    one, two = train_both(wrap)
    assert len(one) == len(two) == 20


@pytest.mark.parametrize("name", ["SAC", "PPO"])
@pytest.mark.parametrize("when", ["pre", "post"])
def test_hooks_of_the_users_own(name, when):
    def watch(model):
        sums = []

        def hook(optimizer, args, kwargs):
            grads = [p.grad for group in optimizer.param_groups for p in group["params"]]
            sums.append(sum(float(g.abs().sum()) for g in grads if g is not None))

        getattr(owner(model), f"register_step_{when}_hook")(hook)
        return sums

    one, two = train_both(watch, name)
    assert len(one) == (30 if name == "PPO" else 20)
    assert one == pytest.approx(two, rel=1e-3)


def test_hooks_on_all_optimizers():
    calls = []

    def count(optimizer, args, kwargs):
        calls.append(type(optimizer))

    handle = register_optimizer_step_post_hook(count)
    try:
        learn(make(sb3_sparse, "SAC"))
        ours = calls[:]
        calls.clear()
        learn(make(STOCK, "SAC"))
    finally:
        handle.remove()
    assert len(calls) >= 60
    assert len(ours) == len(calls)


def test_a_hook_that_comes_and_goes():
    def train(library):
        model, calls = learn(make(library, "DQN")), []
        handle = owner(model).register_step_post_hook(lambda *args: calls.append(1))
        learn(model, steps=5)
        handle.remove()
        return learn(model, steps=5), len(calls)

    (ours, one), (stock, two) = train(sb3_sparse), train(STOCK)
    assert_alike(ours, stock)
    assert one == two == 5


@pytest.mark.parametrize("name", ["SAC", "A2C"])
def test_another_optimizer_in_the_middle(name):
    def train(library):
        model = learn(make(library, name))
        holder = getattr(model.policy, "critic", model.policy)
        params = holder.optimizer.param_groups[0]["params"]
        holder.optimizer = th.optim.Adam(params, lr=1e-3)
        for network in model.policy.sparse.networks:
            if network.optimizer not in optimizers_of(model).values():
                network.optimizer = holder.optimizer
        return learn(model, steps=20)

    assert_alike(train(sb3_sparse), train(STOCK))


@pytest.mark.parametrize("name", ["SAC", "DQN", "PPO", "A2C"])
def test_counters_and_moments_are_torchs_own_tensors(name):
    model = learn(make(sb3_sparse, name))
    held = [state for o in optimizers_of(model).values() for state in o.state.values()]
    places = [t.data_ptr() for state in held for t in state.values() if th.is_tensor(t)]
    weights = [p.data_ptr() for p in model.policy.parameters()]
    before = [float(state["step"]) for state in held]
    learn(model, steps=10)
    assert [p.data_ptr() for p in model.policy.parameters()] == weights
    assert [t.data_ptr() for state in held for t in state.values() if th.is_tensor(t)] == places
    assert all(float(state["step"]) > n for state, n in zip(held, before, strict=True))
