"""What users build on top: subclasses, buffers and policies of their own."""

from __future__ import annotations

import numpy as np
import pytest
import stable_baselines3
import torch as th
from algorithms_support import (
    NAMES,
    OFF_POLICY,
    STOCK,
    assert_alike,
    assert_like_stock,
    fused,
    learn,
    make,
)
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples

import sb3_sparse
from sb3_sparse.fused import Program

LIBRARIES = (sb3_sparse, STOCK)


def both(build, name, **kwargs):
    models = [learn(make(build(getattr(library, name)), name, **kwargs)) for library in LIBRARIES]
    assert_alike(*models)
    return models


@pytest.mark.parametrize("name", NAMES)
def test_a_subclass_that_trains_and_steps_on_top(name):
    def build(base):
        class Own(base):
            trained = stepped = 0

            def train(self, *args, **kwargs):
                super().train(*args, **kwargs)
                self.trained += 1
                with th.no_grad():
                    next(self.policy.parameters()).mul_(0.99)

            def _on_step(self):
                self.stepped += 1
                return super()._on_step()

            def _update_learning_rate(self, optimizers):
                super()._update_learning_rate(optimizers)
                for optimizer in optimizers if isinstance(optimizers, list) else [optimizers]:
                    optimizer.param_groups[0]["lr"] *= 2

        return Own

    ours, stock = both(build, name)
    assert fused(ours)
    assert ours.trained == stock.trained > 0
    assert ours.stepped == stock.stepped


@pytest.mark.parametrize(
    ("name", "mark", "kwargs"),
    [
        ("SAC", "target update", dict(gradient_steps=2, target_update_interval=2)),
        ("TD3", "delayed", {}),
        ("CrossQ", "delayed", {}),
    ],
)
def test_a_gradient_step_without_the_mark_that_it_needs_is_told(name, mark, kwargs, monkeypatch):
    monkeypatch.setattr(Program, "mark", lambda self, name: None)
    model = make(sb3_sparse, name, **kwargs)
    with pytest.raises(ValueError, match=rf"no mark '{mark}'.*program\.mark\('{mark}'\)"):
        learn(model)


def test_a_subclass_may_log_more():
    class Own(sb3_sparse.CrossQ):
        def _record(self, program, source):
            super()._record(program, source)
            program.log("one", program.constant(1.0))

    model = learn(make(Own, "CrossQ"))
    assert fused(model)
    assert model.logger.name_to_value["train/one"] == 1.0


def test_a_subclass_with_a_train_of_its_own_never_asks():
    def build(base):
        class Own(base):
            def train(self, gradient_steps, batch_size=64):
                stable_baselines3.SAC.train(self, gradient_steps, batch_size)

        return Own

    ours, stock = both(build, "SAC")
    assert_alike(ours, stock, exact=True)
    assert not ours._trains()._machines


class Weighted(ReplayBuffer):
    """Halves rewards, and has no random numbers of its own."""

    def _get_samples(self, batch_inds, env=None):
        found = super()._get_samples(batch_inds, env)
        return found._replace(rewards=found.rewards * 0.5)


class Doubled(ReplayBuffer):
    """Gives two for one."""

    def sample(self, batch_size, env=None):
        return super().sample(batch_size * 2, env)


class Shrinking(ReplayBuffer):
    """Gives fewer than it is asked for."""

    def sample(self, batch_size, env=None):
        return super().sample(int(np.random.randint(1, batch_size)), env)


class Discounting(ReplayBuffer):
    """Has a discount for each transition."""

    def _get_samples(self, batch_inds, env=None):
        found = super()._get_samples(batch_inds, env)
        return ReplayBufferSamples(*found[:5], discounts=th.full_like(found.rewards, 0.3))


class Named(ReplayBuffer):
    """Says ``n_steps`` and has no discounts."""

    n_steps = 1


@pytest.mark.parametrize("buffer", [Weighted, Discounting, Named])
@pytest.mark.parametrize("name", OFF_POLICY)
def test_replay_buffers_of_the_users_own(name, buffer):
    assert_like_stock(name, replay_buffer_class=buffer)


@pytest.mark.parametrize("buffer", [Doubled, Shrinking])
@pytest.mark.parametrize("name", ["SAC", "TD3", "DDPG", "DQN"])
def test_replay_buffers_with_batches_of_their_own_size(name, buffer):
    assert_like_stock(name, replay_buffer_class=buffer)


class Half(RolloutBuffer):
    """Gives every second part of a rollout."""

    def get(self, batch_size=None):
        for number, found in enumerate(super().get(batch_size)):
            if number % 2 == 0:
                yield found._replace(advantages=found.advantages * 0.5)


@pytest.mark.parametrize("name", ["PPO", "A2C"])
def test_rollout_buffers_of_the_users_own(name):
    assert_like_stock(name, rollout_buffer_class=Half)


def test_a_buffer_that_is_replaced_in_the_middle():
    def train(library):
        model = learn(make(library, "SAC"))
        old = model.replay_buffer
        model.replay_buffer = Weighted(100, model.observation_space, model.action_space, "cpu")
        names = ("observations", "next_observations", "actions", "rewards", "dones")
        for row in range(40):
            model.replay_buffer.add(*(getattr(old, name)[row] for name in names), [{}])
        return learn(model, steps=10)

    assert_alike(train(sb3_sparse), train(STOCK))


@pytest.mark.parametrize("name", NAMES)
def test_classes_are_stocks_and_go_by_their_names(name):
    ours, stock = (getattr(library, name) for library in LIBRARIES)
    assert issubclass(ours, stock)
    assert ours.__name__ == name
    assert ours.policy_aliases["SparsePolicy"] is stock.policy_aliases["SparsePolicy"]
    model = make(sb3_sparse, name)
    assert "_training" not in vars(model)
    assert "_training" in model._excluded_save_params()


def test_gradients_outside_of_training_are_left_alone():
    model = learn(make(sb3_sparse, "SAC"))
    obs = th.zeros(1, 5)
    model.critic(obs, th.zeros(1, 3))[0].sum().backward()
    grads = [p.grad for p in model.critic.qf0.parameters()]
    assert all(g is not None for g in grads)


@pytest.mark.parametrize("policy", ["SparsePolicy", "MlpPolicy"])
def test_a_file_of_another_algorithm_is_told_from_a_damaged_one(policy, tmp_path):
    kwargs = dict(sparsity=0.9) if policy == "SparsePolicy" else {}
    model = stable_baselines3.SAC(policy, "Pendulum-v1", policy_kwargs=dict(kwargs, net_arch=[8]))
    model.save(tmp_path / "model.zip")
    with pytest.raises(TypeError, match="SACPolicy is a policy of SAC, not of PPO"):
        sb3_sparse.PPO.load(tmp_path / "model.zip")
    assert isinstance(sb3_sparse.SAC.load(tmp_path / "model.zip"), sb3_sparse.SAC)
