"""Training on: rates, exploration and experience."""

from __future__ import annotations

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from support import assert_masked, make

from sb3_sparse import sparsify
from sb3_sparse.compress import finetune
from sb3_sparse.compress.finetune import Annealed, fill_buffer, fine_tune


class Rates(BaseCallback):
    """Notes the learning rate and exploration at each step."""

    def _on_training_start(self) -> None:
        self.rates: list[float] = []
        self.exploration: list[float] = []

    def _on_step(self) -> bool:
        self.rates.append(self.model.policy.optimizer.param_groups[0]["lr"])
        self.exploration.append(getattr(self.model, "exploration_rate", 0.0))
        return True


def watched(model) -> Rates:
    """Callback that the model's next ``learn`` calls."""
    callback, learn = Rates(), type(model).learn
    model.learn = lambda steps, **kwargs: learn(model, steps, callback=callback, **kwargs)
    return callback


def test_a_rate_falls_from_half_way_to_nothing():
    linear = Annealed(lambda remaining: 0.01 * remaining, start=0.2, lag=0.0)
    # at the start of the fine-tuning 0.2 remains, half-way through it 0.1
    assert [linear(r) for r in (0.2, 0.1, 0.05, 0.0, -0.1)] == pytest.approx(
        [0.005, 0.0025, 0.00125, 0.0, 0.0]
    )
    constant = Annealed(lambda remaining: 0.01, start=0.2, lag=0.05)
    # four rollouts: SB3 asks when 0.15, 0.1, 0.05 and 0 remain
    assert [constant(r) for r in (0.15, 0.1, 0.05, 0.0)] == pytest.approx(
        [0.01, 0.0075, 0.005, 0.0025]
    )


def test_a_schedule_that_had_ended_trains_and_comes_back():
    model = make("PPO", policy="MlpPolicy", learning_rate=lambda remaining: 0.01 * remaining)
    model.learn(64)
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.0
    twin = sparsify(model, 0.5)
    schedule, clip_range = twin.lr_schedule, twin.clip_range
    callback = watched(twin)
    fine_tune(twin, 128)
    # rollouts of 32: rates 0.005 * (4, 3, 2) / 4 before the second, third and fourth
    assert callback.rates[32::32] == pytest.approx([0.005, 0.00375, 0.0025])
    assert twin.lr_schedule is schedule
    assert twin.clip_range is clip_range
    assert_masked(twin)


def test_exploration_stays_at_its_end_however_short_the_training_was():
    model = make("DQN", policy="MlpPolicy", exploration_final_eps=0.07, learning_starts=10_000)
    model.learn(20)
    twin = sparsify(model, 0.5)
    schedule = twin.exploration_schedule
    callback = watched(twin)
    fine_tune(twin, 200)
    assert set(callback.exploration[1:]) == {0.07}
    assert (twin.exploration_schedule, twin.learning_starts) == (schedule, 10_000)
    assert twin.policy.sparse.networks[0].clock > 100  # it learnt, whatever learning_starts says


@pytest.mark.parametrize("name", ["SAC", "DQN", "TD3"])
def test_an_empty_buffer_is_filled_without_learning(name, tmp_path, monkeypatch):
    monkeypatch.setattr(finetune, "EXPERIENCE", 150)
    model = make(name, policy="MlpPolicy").learn(60)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=model.env, device="cpu")
    before = [p.clone() for p in loaded.policy.parameters()]
    assert fill_buffer(loaded) == 150
    assert loaded.replay_buffer.size() == 150
    assert loaded.num_timesteps == model.num_timesteps + 150
    assert loaded.gradient_steps == 1
    if name != "DQN":  # whose target follows in the environment's step
        assert all((a == b).all() for a, b in zip(before, loaded.policy.parameters(), strict=True))
    assert fill_buffer(loaded) == 0


def test_a_small_buffer_is_filled_once(monkeypatch):
    model = make("SAC", policy="MlpPolicy", buffer_size=100, batch_size=200)
    assert fill_buffer(model) == 100
    assert fill_buffer(model) == 0
