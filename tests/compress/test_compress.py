"""Compressions of real, small models."""

from __future__ import annotations

import json

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.atari_wrappers import EpisodicLifeEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from support import assert_masked, make

from sb3_sparse import sparsify
from sb3_sparse.analysis.evaluation import check_eval_env, episode_returns
from sb3_sparse.compress import compress_model, finetune
from sb3_sparse.compress import pruner as pruner_module
from sb3_sparse.errors import ConfigError, CorruptStateError

QUICK = dict(steps=64, episodes=4, seed=3)


def cartpole(n_envs: int = 2, normalized: bool = False, training: bool = True):
    env = make_vec_env("CartPole-v1", n_envs=n_envs, seed=0)
    return VecNormalize(env, training=training, norm_reward=training) if normalized else env


def trained(normalized: bool = False, steps: int = 64) -> PPO:
    return make("PPO", env=cartpole(normalized=normalized), policy="MlpPolicy").learn(steps)


def tensors(path) -> dict[str, th.Tensor]:
    return PPO.load(path, device="cpu").policy.state_dict()


def test_a_fixed_sparsity_ends_at_it_and_says_what_it_cost(tmp_path):
    model = trained()
    before = {key: value.clone() for key, value in model.policy.state_dict().items()}
    lines: list[str] = []
    outcome = compress_model(
        model, cartpole(), tmp_path / "out", sparsity=0.7, say=lines.append, name="final", **QUICK
    )
    assert [level.sparsity for level in outcome.levels] == [0.4, 0.64, 0.7]
    assert outcome.sparsity == {"actor": 0.7, "critic": 0.0}
    assert outcome.path == tmp_path / "out" / "final.zip"
    loaded = PPO.load(outcome.path, device="cpu")
    networks = {network.name: network for network in loaded.policy.sparse.networks}
    # 4-24-24-2: 96 + 576 + 48
    assert outcome.nnz_before == 720
    assert outcome.nnz == networks["actor"].nnz == pytest.approx(0.3 * 720, abs=3)
    assert networks["critic"].nnz == networks["critic"].size
    assert loaded.num_timesteps == 64 + 3 * 64
    assert_masked(loaded)
    assert outcome.change.mean == pytest.approx(outcome.outcome.mean - outcome.baseline.mean)
    assert len(lines) == 3
    assert lines[0].startswith("Level 1: sparsity 40.00% (")
    assert "fresh episodes each" in str(outcome)
    assert not (tmp_path / "out" / "levels").exists()
    for key, value in before.items():
        assert th.equal(value, model.policy.state_dict()[key]), key
    again = compress_model(model, cartpole(), tmp_path / "out", sparsity=0.7, name="final", **QUICK)
    assert again == outcome
    with pytest.raises(ConfigError, match="seed 3 instead of 4"):
        compress_model(
            model, cartpole(), tmp_path / "out", sparsity=0.7, name="final", **{**QUICK, "seed": 4}
        )


def test_a_guarded_search_ends_with_a_model_that_does_what_it_says(tmp_path):
    env = make_vec_env("CartPole-v1", n_envs=8, seed=0)
    model = PPO(
        "MlpPolicy", env, n_steps=32, batch_size=256, n_epochs=10, gamma=0.98, gae_lambda=0.8,
        learning_rate=2e-3, seed=0, device="cpu", policy_kwargs=dict(net_arch=[32, 32]),
    )  # fmt: skip
    model.learn(6_000)
    evaluation = make_vec_env("CartPole-v1", n_envs=5)
    outcome = compress_model(model, evaluation, tmp_path, max_drop=0.5, steps=512, episodes=5)
    passed = [level for level in outcome.levels if level.verdict == "passed"]
    assert passed
    for level in passed:
        baseline = np.mean(level.returns) - level.change.mean
        assert level.change.low >= -0.5 * baseline
    assert outcome.sparsity["actor"] == max(level.sparsity for level in passed)
    loaded = PPO.load(outcome.path, device="cpu")
    assert loaded.policy.sparse.networks[0].nnz == outcome.nnz < outcome.nnz_before
    fresh: list[float] = []
    while len(fresh) < outcome.episodes:
        seed = 1000 * (1001 + len(fresh) // 5)
        fresh += episode_returns(loaded, evaluation, 5, seed, deterministic=True)
    assert outcome.outcome.mean == np.mean(fresh)


@pytest.mark.parametrize("normalized", [False, True])
def test_an_interrupted_compression_comes_out_as_an_uninterrupted_one(
    normalized, tmp_path, monkeypatch
):
    def run(folder):
        model = trained(normalized)
        evaluation = cartpole(normalized=normalized, training=False)
        return compress_model(model, evaluation, folder, sparsity=0.8, **QUICK)

    whole = run(tmp_path / "whole")
    fine_tune, calls = pruner_module.fine_tune, []

    def interrupting(model, steps):
        calls.append(steps)
        fine_tune(model, steps)
        if len(calls) in (1, 3):
            raise KeyboardInterrupt

    monkeypatch.setattr(pruner_module, "fine_tune", interrupting)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "parts")
    assert len(json.loads((tmp_path / "parts" / "compress.json").read_text())["levels"]) == 1
    assert (tmp_path / "parts" / "levels" / "1.zip").is_file()
    parts = run(tmp_path / "parts")
    assert len(calls) == 3 + 3  # levels 1, 1, 2 and then 2, 3, 4
    assert parts.levels == whole.levels
    assert (parts.outcome, parts.baseline) == (whole.outcome, whole.baseline)
    ours, theirs = tensors(whole.path), tensors(parts.path)
    for key, value in ours.items():
        assert th.equal(value, theirs[key]), key
    if normalized:
        statistics = [
            VecNormalize.load(str(tmp_path / part / "model" / "vecnormalize.pkl"), cartpole())
            for part in ("whole", "parts")
        ]
        np.testing.assert_array_equal(statistics[0].obs_rms.mean, statistics[1].obs_rms.mean)


def test_normalisation_is_that_of_each_level(tmp_path):
    model = trained(normalized=True)
    normalize = model.get_vec_normalize_env()
    before = normalize.obs_rms.count
    evaluation = cartpole(normalized=True, training=False)
    compress_model(model, evaluation, tmp_path, sparsity=0.5, **QUICK)
    saved = VecNormalize.load(str(tmp_path / "model" / "vecnormalize.pkl"), cartpole())
    # two levels of 64 steps, and a reset of 2 environments before each
    assert saved.obs_rms.count == pytest.approx(before + 2 * (64 + 2))


@pytest.mark.parametrize("name", ["DQN", "SAC"])
def test_off_policy_models_get_experience_first(name, tmp_path, monkeypatch):
    monkeypatch.setattr(finetune, "EXPERIENCE", 200)
    make(name, policy="MlpPolicy").learn(60).save(tmp_path / "model")
    env_id = "CartPole-v1" if name == "DQN" else "Pendulum-v1"
    cls = type(make(name))
    model = cls.load(tmp_path / "model", env=make_vec_env(env_id), device="cpu")
    outcome = compress_model(model, make_vec_env(env_id), tmp_path / "out", sparsity=0.5, **QUICK)
    loaded = cls.load(outcome.path, device="cpu")
    assert loaded.num_timesteps == 60 + 200 + 2 * 64
    assert model.replay_buffer.size() == 200 + 2 * 64
    assert model.num_timesteps == 60
    assert_masked(loaded)
    assert outcome.network == {"DQN": "q_net", "SAC": "actor"}[name]


def test_a_sparse_model_goes_on_from_what_it_has(tmp_path):
    model = sparsify(trained(), {"actor": 0.8, "critic": 0.5})
    outcome = compress_model(model, cartpole(), tmp_path, sparsity=0.9, **QUICK)
    assert [level.sparsity for level in outcome.levels] == [0.88, 0.9]
    assert outcome.sparsity == {"actor": 0.9, "critic": 0.5}
    with pytest.raises(ConfigError, match=r"sparsity=0.8 is not above the 0.8 that the actor has"):
        compress_model(model, cartpole(), tmp_path / "other", sparsity=0.8, **QUICK)


def test_a_lost_model_is_missed(tmp_path, monkeypatch):
    monkeypatch.setattr(
        pruner_module.ModelPruner, "finish", lambda *_: (_ for _ in ()).throw(KeyError)
    )
    with pytest.raises(KeyError):
        compress_model(trained(), cartpole(), tmp_path, sparsity=0.5, **QUICK)
    (tmp_path / "levels" / "2.zip").unlink()
    with pytest.raises(CorruptStateError, match=r"2.zip is missing; remove"):
        compress_model(trained(), cartpole(), tmp_path, sparsity=0.5, **QUICK)


def test_mistakes_are_named(tmp_path):
    model = trained()
    for kwargs, message in (
        (dict(max_drop=0.1, sparsity=0.5), "either a largest drop or a fixed sparsity"),
        (dict(max_drop=1.5), r"max_drop must lie in \[0, 1\)"),
        (dict(sparsity=1.0), r"must lie in \[0, 1\)"),
        (dict(steps=0), "steps must be 1 or more, got 0"),
        (dict(episodes=1), "episodes must be 2 or more, got 1"),
        (dict(distribution="flat"), "unknown distribution 'flat'"),
    ):
        with pytest.raises(ConfigError, match=message):
            compress_model(model, cartpole(), tmp_path / "out", **kwargs)
    with pytest.raises(ConfigError, match="must both be normalised"):
        compress_model(model, cartpole(normalized=True, training=False), tmp_path / "out")
    with pytest.raises(ConfigError, match="normalises rewards"):
        compress_model(model, cartpole(normalized=True), tmp_path / "out")
    model.env = None
    with pytest.raises(ConfigError, match="no environment to be fine-tuned in"):
        compress_model(model, cartpole(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_returns_are_those_of_sb3_and_the_same_for_the_same_seed():
    model = trained()
    env = make_vec_env("CartPole-v1", n_envs=1)
    ours = episode_returns(model, env, 6, seed=11, deterministic=True)
    env.seed(11)
    theirs, _ = evaluate_policy(model, env, 6, return_episode_rewards=True)
    assert ours == theirs
    several = make_vec_env("CartPole-v1", n_envs=4)
    once = episode_returns(model, several, 6, seed=11, deterministic=False)
    th.manual_seed(5)
    expected = th.rand(1)
    th.manual_seed(5)
    assert once == episode_returns(model, several, 6, seed=11, deterministic=False)
    assert th.equal(th.rand(1), expected)
    assert len(once) == 8
    assert once != episode_returns(model, several, 6, seed=12, deterministic=False)


class ThreeLives(gym.Env):
    """As an Atari game: a life goes every 5 steps, each step brings 1."""

    observation_space = gym.spaces.Box(-5, 5, (4,))
    action_space = gym.spaces.Discrete(2)
    ale = property(lambda self: self)

    def lives(self) -> int:
        return 3 - self.steps // 5

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(4, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(4, np.float32), 1.0, self.steps >= 15, False, {}


def test_a_game_of_several_lives_counts_as_a_whole():
    def envs(count):
        return DummyVecEnv([lambda: EpisodicLifeEnv(Monitor(ThreeLives()))] * count)

    model, env = trained(), envs(1)
    for seed in (1, 2):
        assert episode_returns(model, env, 3, seed, deterministic=False) == [15.0] * 3
    check_eval_env(env)
    with pytest.raises(ConfigError, match="2 evaluation environments end an episode with each"):
        check_eval_env(envs(2))


def test_rewards_are_added_up_where_there_is_no_monitor():
    env = DummyVecEnv([ThreeLives] * 3)
    assert episode_returns(trained(), env, 4, seed=1, deterministic=True) == [15.0] * 6


def test_each_model_is_evaluated_with_its_own_normalisation(tmp_path):
    model = trained(normalized=True)
    evaluation = cartpole(normalized=True, training=False)
    pruner = pruner_module.ModelPruner(model, evaluation, tmp_path, 64, 4, 0, True, None)
    before = model.get_vec_normalize_env().obs_rms.count
    first = pruner.returns(True, 0)
    pruner.make(1, 0.5)
    pruner.returns(False, 0)
    assert evaluation.obs_rms.count == model.get_vec_normalize_env().obs_rms.count > before + 64
    assert pruner.returns(True, 0) == first
    assert evaluation.obs_rms.count == before


def test_normalisation_of_rewards_alone(tmp_path):
    env = VecNormalize(make_vec_env("CartPole-v1", n_envs=2, seed=0), norm_obs=False)
    evaluation = make_vec_env("CartPole-v1", n_envs=2)
    evaluation = VecNormalize(evaluation, training=False, norm_obs=False, norm_reward=False)
    model = make("PPO", env=env, policy="MlpPolicy").learn(64)
    outcome = compress_model(model, evaluation, tmp_path, sparsity=0.5, **QUICK)
    assert outcome.sparsity["actor"] == 0.5
    assert (tmp_path / "model" / "vecnormalize.pkl").is_file()


def test_a_sparsity_that_leaves_layers_empty_is_refused(tmp_path):
    # 4-24-24-2 has three layers, so at least 3 of 720 connections: 99.58 %
    with pytest.raises(ConfigError, match=r"sparsity=0.9999 leaves less.*allowed is up to 0.9958"):
        compress_model(trained(), cartpole(), tmp_path, sparsity=0.9999, **QUICK)


def test_a_first_look_binds_nobody(tmp_path, monkeypatch):
    model = trained()

    def stop(model, steps):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pruner_module, "fine_tune", stop)
        with pytest.raises(KeyboardInterrupt):
            compress_model(model, cartpole(), tmp_path, sparsity=0.4, **QUICK)
    other = {**QUICK, "episodes": 6}
    outcome = compress_model(model, cartpole(), str(tmp_path), sparsity=0.4, **other)
    assert outcome.episodes == 6
    outcome.path.unlink()
    with pytest.raises(CorruptStateError, match="is finished, but .*model.zip is missing"):
        compress_model(model, cartpole(), tmp_path, sparsity=0.4, **other)
    with pytest.raises(ConfigError, match="must be a VecEnv, got"):
        compress_model(model, gym.make("CartPole-v1").env, tmp_path, sparsity=0.4, **other)
