"""Multi-step returns and a buffer that forgets, during training."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch as th
from algorithms_support import BOX, Noise, assert_alike, fused, learn, make
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    CallbackList,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecNormalize

import sb3_sparse
from sb3_sparse import (
    RecycleDormantCallback,
    ResetCallback,
    RobustValueCallback,
    SparsityCallback,
)
from sb3_sparse.buffers import DynamicReplayBuffer
from sb3_sparse.errors import ConfigError

INF = float("inf")
ALGORITHMS = [
    (library, name)
    for library in (stable_baselines3, sb3_sparse)
    for name in ("SAC", "TD3", "DDPG")
] + [(sb3_contrib, "TQC"), (sb3_contrib, "CrossQ")]
IDS = [f"{library.__name__}.{name}" for library, name in ALGORITHMS]
each_algorithm = pytest.mark.parametrize(("library", "name"), ALGORITHMS, ids=IDS)


def made(library, name, **kwargs):
    """A model; those of sb3-contrib take what SAC takes."""
    cls = getattr(library, name)
    if library is sb3_contrib:
        kwargs = {"learning_starts": 20, "buffer_size": 200, "batch_size": 70, **kwargs}
    return make(cls, name, kwargs.pop("env", Noise(BOX)), **kwargs)


def rigl():
    return SparsityCallback("rigl", update_interval=2, drop_fraction=0.3, end=1.0)


def trained(model, *callbacks, steps=50):
    return model.learn(steps, [*callbacks], log_interval=10**9, reset_num_timesteps=False)


def logged(model, name):
    return model.logger.name_to_value[f"robust_value/{name}"]


@each_algorithm
def test_without_its_callback_rlx2_is_rigl_bit_for_bit(library, name):
    plain = trained(made(library, name), rigl())
    buffer = trained(made(library, name, replay_buffer_class=DynamicReplayBuffer), rigl())
    assert type(plain.replay_buffer) is not type(buffer.replay_buffer)
    assert_alike(buffer, plain, exact=True)


@each_algorithm
def test_one_step_and_an_infinite_threshold_change_nothing(library, name):
    plain = trained(made(library, name), rigl())
    callback = RobustValueCallback(multi_step=1, distance_threshold=INF, check_interval=3)
    other = trained(made(library, name), rigl(), callback)
    assert logged(other, "distance") >= 0
    assert_alike(other, plain, exact=True)


@pytest.mark.parametrize("name", ["SAC", "TD3", "DDPG"])
def test_ours_trains_as_stock_in_fused_steps(name):
    models = []
    for library in (sb3_sparse, stable_baselines3):
        callback = RobustValueCallback(
            check_interval=5,
            distance_threshold=1e-5,
            min_buffer_size=20,
            oldest=4,
            multi_step_begin=0.7,
        )
        models.append(learn(make(library, name), [rigl(), callback]))
    ours, stock = models
    assert fused(ours)
    assert ours.why_not_fused() is None
    assert_alike(ours, stock)
    assert ours.replay_buffer.size() == stock.replay_buffer.size() < 50
    assert ours.replay_buffer.n_steps == 3


def test_returns_are_over_several_steps_from_their_begin_on():
    seen = []

    class Watch(sb3_sparse.SparsityCallback):
        def _on_rollout_start(self):
            super()._on_rollout_start()
            seen.append(self.model.replay_buffer.n_steps)

    model = made(stable_baselines3, "TD3", gamma=0.7)
    trained(model, Watch("static"), RobustValueCallback(multi_step=4, multi_step_begin=0.5))
    assert seen == [1] * 25 + [4] * 25  # after the rollouts of steps 0 to 49
    assert logged(model, "n_steps") == 4
    assert logged(model, "buffer_size") == 50
    assert model.replay_buffer.gamma == 0.7
    model.gamma = 0.8
    trained(model, RobustValueCallback(), steps=2)
    assert model.replay_buffer.gamma == 0.8


@pytest.mark.parametrize("name", ["SAC", "TD3"])
def test_action_means_are_those_of_the_policy_that_acted(name):
    env = VecNormalize(make_vec_env(lambda: Noise(spaces.Box(-2.0, 4.0, (3,))), 2))
    env.training = False
    env.obs_rms.mean[:], env.obs_rms.var[:] = 0.3, 0.5
    noise = NormalActionNoise(np.zeros(3), np.full(3, 0.3))
    model = made(
        stable_baselines3,
        name,
        env=env,
        gradient_steps=0,
        train_freq=4,
        learning_starts=20,
        action_noise=noise,
    )
    means, inputs = [], []

    class Watch(sb3_sparse.SparsityCallback):
        def _on_step(self):
            observations = self.locals["self"]._last_obs
            actions, _ = self.model.predict(observations, deterministic=True)
            means.append((actions - 1.0) / 3.0)  # the bounds are -2 and 4
            inputs.append(self.model._last_original_obs)
            return super()._on_step()

    trained(model, Watch("static"), RobustValueCallback(), steps=64)
    buffer = model.replay_buffer
    assert buffer.size() == 32
    assert buffer.without_means == 0
    assert np.allclose(buffer.observations[:32], inputs)
    assert (buffer.action_means[:10] == buffer.actions[:10]).all()  # at random, 2 a row
    assert not np.allclose(buffer.action_means[10:32], buffer.actions[10:32], atol=0.05)
    np.testing.assert_allclose(buffer.action_means[10:32], means[10:], atol=1e-6)


def zero_policy():
    """A model whose policy always acts by 0, and twelve transitions in its buffer."""
    model = made(stable_baselines3, "TD3", buffer_size=12, learning_starts=100)
    callback = RobustValueCallback(check_interval=10, distance_threshold=0.2, oldest=4)
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.zero_()
    trained(model, callback, steps=15)
    model.replay_buffer.action_means[:] = 0
    return model, callback


def set_means(model, means):
    """Set the action means of rows, from the oldest; each of three actions is the same."""
    buffer = model.replay_buffer
    buffer.action_means[buffer.oldest(len(means))] = np.reshape(means, (-1, 1, 1))


@pytest.mark.parametrize(
    ("means", "least", "distance", "left"),
    [
        # ½ · 1² = 0.5 is forgotten; ½ · 0.6² = 0.18 is near enough
        ([1.0] * 4 + [0.6] * 8, 1, 0.5, 8),
        # ½ · (1 + 1 + 0 + 0) / 4 = 0.25; then ½ · 0.8² = 0.32; then 0
        ([1.0, 1.0, 0.0, 0.0, *[-0.8] * 4, *[0.0] * 4], 1, 0.25, 4),
        # ½ · (1 + 0 + 0 + 0) / 4 = 0.125
        ([1.0, 0.0, 0.0, 0.0, *[1.0] * 8], 1, 0.125, 12),
        # what exceeds the minimum of 7 is forgotten, at first 4, then 1
        ([1.0] * 12, 7, 0.5, 7),
        # fewer than the minimum
        ([1.0] * 12, 13, 0.5, 12),
        # all parted: the last block has 4, of which 1 stays
        ([1.0] * 12, 1, 0.5, 1),
    ],
)
def test_the_oldest_are_forgotten_while_they_part_by_more_than_the_threshold(
    means, least, distance, left
):
    model, callback = zero_policy()
    callback.min_buffer_size = least
    set_means(model, means)
    before = model.replay_buffer.oldest(12).tolist()
    model._n_updates = 20
    callback.on_rollout_start()
    assert logged(model, "distance") == pytest.approx(distance)
    assert model.replay_buffer.oldest(model.replay_buffer.size()).tolist() == before[12 - left :]


def test_a_distance_at_the_threshold_is_no_more_than_it():
    model, callback = zero_policy()
    callback.distance_threshold, callback.min_buffer_size = 0.125, 1
    set_means(model, [0.5] * 4 + [1.0] * 8)  # ½ · 0.5² = 0.125
    model._n_updates = 20
    callback.on_rollout_start()
    assert model.replay_buffer.size() == 12


def test_a_comparison_is_due_when_gradient_steps_pass_a_multiple():
    model, callback = zero_policy()
    counted = []
    callback.act = counted.append
    for done in (9, 10, 11, 19, 35, 36, 40):
        model._n_updates = done
        callback.on_rollout_start()
    assert counted == [10, 35, 40]


def test_rows_of_several_environments_are_forgotten_together():
    env = make_vec_env(lambda: Noise(BOX), 3)
    model = made(stable_baselines3, "TD3", env=env, buffer_size=30, learning_starts=100)
    callback = RobustValueCallback(
        check_interval=10, min_buffer_size=13, oldest=8, distance_threshold=0
    )
    trained(model, callback, steps=30)
    model.replay_buffer.action_means[:] = 9
    model._n_updates = 10
    callback.on_rollout_start()  # 8 are 3 rows, and 13 are 5 rows
    assert model.replay_buffer.size() == 5


def test_a_rollout_of_whole_episodes_has_all_its_means():
    model = made(stable_baselines3, "TD3", train_freq=(1, "episode"), learning_starts=0)
    stop = StopTrainingOnMaxEpisodes(3)
    trained(model, RobustValueCallback(), stop, steps=60)
    buffer = model.replay_buffer
    assert buffer.without_means == 0
    assert (buffer.action_means[: buffer.size()] != 0).all()


@pytest.mark.parametrize("name", ["SAC", "TD3"])
def test_a_resumed_training_is_the_uninterrupted_one(name, tmp_path):
    def callbacks():
        return [
            rigl(),
            RobustValueCallback(
                check_interval=7,
                distance_threshold=1e-5,
                min_buffer_size=12,
                oldest=3,
                multi_step_begin=0.9,
            ),
        ]

    models = []
    for saved in (False, True):
        env = make_vec_env(lambda: Noise(BOX), 1, seed=0)
        model = made(sb3_sparse, name, env=env)
        trained(model, *callbacks(), steps=41)  # the 21 gradient steps are a multiple of 7
        if saved:
            model.save(tmp_path / "model.zip")
            model.save_replay_buffer(tmp_path / "buffer.pkl")
            episode = copy.deepcopy(model._last_obs), model._last_episode_starts, model._episode_num
            model = type(model).load(tmp_path / "model.zip", env=env, force_reset=False)
            assert isinstance(model.replay_buffer, DynamicReplayBuffer)
            model.load_replay_buffer(tmp_path / "buffer.pkl")
            model._last_obs, model._last_episode_starts, model._episode_num = episode
        np.random.seed(5)
        th.manual_seed(5)
        model.action_space.seed(5)
        trained(model, *callbacks(), steps=20)
        models.append(model)
    whole, resumed = models
    assert_alike(resumed, whole, exact=True)
    one, two = whole.replay_buffer, resumed.replay_buffer
    assert one.size() == two.size() < 61
    assert one.n_steps == two.n_steps == 3
    assert (one.action_means == two.action_means).all()


def test_experience_from_before_the_callback_gets_the_means_of_its_start():
    model = trained(made(stable_baselines3, "SAC"), steps=30)
    observations = model.replay_buffer.observations[:30, 0]
    expected = model.policy.scale_action(model.predict(observations, deterministic=True)[0])
    trained(model, RobustValueCallback(), steps=5)
    assert model.replay_buffer.size() == 35
    np.testing.assert_allclose(model.replay_buffer.action_means[:30, 0], expected, atol=1e-6)


def test_many_means_are_predicted_in_parts(monkeypatch):
    model = trained(made(stable_baselines3, "TD3", learning_starts=100), steps=50)
    seen, predict = [], model.policy.predict

    def watched(observations, **kwargs):
        seen.append(len(observations))
        return predict(observations, **kwargs)

    monkeypatch.setattr(model.policy, "predict", watched)
    callback = RobustValueCallback(oldest=16)
    callback.init_callback(model)
    callback.on_training_start({}, {})
    assert seen == [16, 16, 16, 2]
    observations = model.replay_buffer.observations[:50, 0]
    expected = model.policy.scale_action(predict(observations, deterministic=True)[0])
    np.testing.assert_allclose(model.replay_buffer.action_means[:50, 0], expected, atol=1e-6)


@pytest.mark.parametrize(
    "callback", [RobustValueCallback(), ResetCallback(), RecycleDormantCallback()]
)
def test_inside_a_callback_that_passes_on_steps_only_it_is_refused(callback):
    inside = EveryNTimesteps(5, CallbackList([callback]))
    with pytest.raises(ConfigError, match=f"{type(callback).__name__} acts when rollouts begin"):
        made(stable_baselines3, "SAC").learn(20, inside)


@pytest.mark.parametrize(
    ("library", "name", "kwargs", "said"),
    [
        (sb3_sparse, "DQN", {}, "needs SAC, .*, TQC or CrossQ, got DQN with Discrete actions"),
        (sb3_sparse, "PPO", {}, "needs SAC, .*, TQC or CrossQ, got PPO"),
        (
            sb3_sparse,
            "SAC",
            {"n_steps": 3},
            "got NStepReplayBuffer; for RobustValueCallback leave out n_steps",
        ),
        (
            sb3_sparse,
            "SAC",
            {
                "optimize_memory_usage": True,
                "replay_buffer_kwargs": {"handle_timeout_termination": False},
            },
            "got ReplayBuffer with it; for RobustValueCallback leave out",
        ),
    ],
)
def test_what_it_cannot_train_is_refused_at_once(library, name, kwargs, said):
    with pytest.raises(ConfigError, match=said):
        make(library, name, **kwargs).learn(1, RobustValueCallback())


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [
        ({"multi_step": 0}, "multi_step must be a whole number, 1 or more, got 0"),
        ({"check_interval": 1e4}, "check_interval must be a whole number, 1 or more, got 10000.0"),
        ({"oldest": "all"}, "oldest must be a whole number, 1 or more, got 'all'"),
        ({"min_buffer_size": True}, "min_buffer_size must be a whole number, 1 or more, got True"),
        ({"multi_step_begin": 3e5}, r"must lie in \[0, 1\], got 300000.0"),
        ({"distance_threshold": -0.1}, "distance_threshold must be a number, 0 or more, got -0.1"),
        ({"distance_threshold": float("nan")}, "distance_threshold must be a number, 0 or more"),
    ],
)
def test_values_that_are_not_allowed_are_refused(kwargs, said):
    with pytest.raises(ConfigError, match=said):
        RobustValueCallback(**kwargs)
