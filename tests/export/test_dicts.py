"""Observations in a dict, of any number of keys, and models of hindsight experience replay."""

import numpy as np
import pytest
from export.tools import Task
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from support import make

from sb3_sparse import sparsify
from sb3_sparse.errors import ConfigError
from sb3_sparse.export import export, record_observations
from sb3_sparse.export.artifact import predictor
from sb3_sparse.policies.saving import load_without_buffer

PARTS = {
    "vector": spaces.Box(-2, 2, (7,), np.float32),
    "one of five": spaces.Discrete(5),
    "matrix": spaces.Box(-1, 1, (2, 3), np.float32),
    "switches": spaces.MultiBinary(4),
    "choices": spaces.MultiDiscrete([3, 2, 4]),
}
TORQUE = spaces.Box(-1, 1, (2,), np.float32)
THREE = spaces.Discrete(3)


def dicts(count):
    return spaces.Dict({key: PARTS[key] for key in list(PARTS)[:count]})


def samples(space, count):
    space.seed(3)
    found = [space.sample() for _ in range(count)]
    return {key: np.stack([one[key] for one in found]) for key in space.spaces}


@pytest.mark.parametrize("keys", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("algorithm", ["SAC", "TD3", "DQN", "PPO", "TQC", "QRDQN"])
def test_dense_zips_act_as_the_model_row_by_row(algorithm, keys, tmp_path):
    action = THREE if algorithm in ("DQN", "QRDQN") else TORQUE
    model = make(algorithm, Task(dicts(keys), action), policy_kwargs=dict(sparsity=0.6))
    seen = samples(model.observation_space, 7)  # 7 is a multiple of no number of keys but 1
    report = export(model, tmp_path / "dense", "dense", observations=seen)
    assert report.parity.holds
    assert (report.parity.recorded, report.parity.random) == (7, 1000)
    stock = type(model).load(tmp_path / "dense.zip")
    assert type(stock.policy).__module__.startswith(("stable_baselines3.", "sb3_contrib."))
    expected, _ = model.predict(seen, deterministic=True)
    np.testing.assert_array_equal(stock.predict(seen, deterministic=True)[0], expected)
    rows = predictor(model, None)(seen)
    one, _ = model.predict({key: part[4] for key, part in seen.items()}, deterministic=True)
    assert rows.shape == (7, 1 if action is THREE else 2)
    np.testing.assert_allclose(rows[4], np.reshape(one, -1), atol=1e-6)


def test_images_among_the_keys(tmp_path):
    model = make("PPO", "TinyDicts-v0")
    report = export(model, tmp_path / "dense", "dense")
    assert report.parity.holds
    assert report.parity.random == 100
    seen = record_observations(model, DummyVecEnv([lambda: model.env.envs[0].unwrapped]), 5)
    assert seen["image"].shape == (5, 1, 36, 36)
    assert export(model, tmp_path / "dense", "dense", observations=seen).parity.recorded == 5


@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_other_formats_refuse_dicts_and_say_what_to_do(to, tmp_path):
    model = make("PPO", Task(dicts(2), TORQUE))
    with pytest.raises(TypeError, match=r"Dict\(.*cannot be exported.*FlattenObservation"):
        export(model, tmp_path / "policy", to)
    assert not list(tmp_path.iterdir())


def test_recorded_dicts_must_be_of_the_policys_keys_shapes_and_rows(tmp_path):
    model = make("PPO", Task(dicts(2), TORQUE))
    seen = samples(model.observation_space, 4)
    for wrong, message in (
        ({"vector": seen["vector"]}, r"the keys \['one of five', 'vector'\], got \['vector'\]"),
        (seen["vector"], "a dict of arrays with the keys .* got ndarray"),
        ({**seen, "vector": seen["vector"][:, :3]}, r"\['vector'\] must .*shape \(7,\).*\(4, 3\)"),
        ({**seen, "vector": seen["vector"][:3]}, "as many rows for each key.*3.*4|4.*3"),
        ({**seen, "vector": seen["vector"] * np.nan}, r"\['vector'\] must be finite"),
    ):
        with pytest.raises(ConfigError, match=message):
            export(model, tmp_path / "dense", "dense", observations=wrong)


def test_an_environment_of_other_keys_is_refused():
    model = make("PPO", Task(dicts(2), TORQUE))
    for other in (dicts(3), spaces.Dict({**dicts(1).spaces, "one of five": spaces.Discrete(9)})):
        env = DummyVecEnv([lambda other=other: Task(other, TORQUE)])
        with pytest.raises(ConfigError, match=r"shows observations in Dict.*takes those in Dict"):
            record_observations(model, env, 5)


def test_normalised_and_stacked_dicts(tmp_path):
    space = spaces.Dict({"a": PARTS["vector"], "b": spaces.Box(-5, 5, (2,), np.float32)})
    plain = DummyVecEnv([lambda: Task(space, TORQUE)])
    normalised = VecNormalize(plain, norm_obs_keys=["b"])
    model = make("SAC", normalised)
    model.learn(40)
    seen = record_observations(model, normalised, 10)
    assert np.abs(seen["b"]).max() > 2  # raw
    report = export(model, tmp_path / "dense", "dense", observations=seen)
    assert report.parity.holds
    assert "does not normalise" in str(report)
    stacked = VecFrameStack(VecNormalize(DummyVecEnv([lambda: Task(space, TORQUE)])), 3)
    model = make("PPO", stacked)
    seen = record_observations(model, stacked, 10)
    assert {key: part.shape for key, part in seen.items()} == {"a": (10, 21), "b": (10, 6)}
    assert export(model, tmp_path / "stacked", "dense", observations=seen).parity.recorded == 10


def hindsight(algorithm, **arguments):
    env = BitFlippingEnv(n_bits=4, continuous=algorithm != "DQN", max_steps=4)
    arguments |= dict(replay_buffer_class=HerReplayBuffer, buffer_size=500, learning_starts=8)
    model = make(algorithm, env, replay_buffer_kwargs=dict(n_sampled_goal=2), **arguments)
    model.learn(24)
    return model


@pytest.mark.parametrize("algorithm", ["DQN", "SAC", "TD3", "TQC"])
def test_models_of_hindsight_experience_replay(algorithm, tmp_path):
    model = hindsight(algorithm)
    assert export(model, tmp_path / "dense", "dense").parity.holds
    model.save(tmp_path / "model.zip")
    alone = load_without_buffer(type(model), tmp_path / "model.zip")
    assert alone.env is None
    assert alone.replay_buffer is None
    assert export(alone, tmp_path / "again", "dense").parity.holds
    twin = sparsify(alone, 0.95)
    seen = samples(model.observation_space, 3)
    assert twin.predict(seen, deterministic=True)[0].shape[0] == 3
    stock = type(model).load(tmp_path / "again.zip", env=model.get_env())
    assert isinstance(stock.replay_buffer, HerReplayBuffer)
    assert stock.replay_buffer.buffer_size == 500
    stock.learning_starts = stock.num_timesteps + 8  # an empty one gives nothing
    stock.learn(16, reset_num_timesteps=False)


@pytest.mark.parametrize("algorithm", ["SAC", "DQN"])
def test_a_dense_zip_of_a_loaded_model_keeps_the_settings_of_its_replay_buffer(algorithm, tmp_path):
    kwargs = dict(handle_timeout_termination=False)
    model = make(
        algorithm, optimize_memory_usage=True, buffer_size=777, replay_buffer_kwargs=kwargs
    )
    model.save(tmp_path / "model.zip")
    alone = load_without_buffer(type(model), tmp_path / "model.zip")
    export(alone, tmp_path / "dense", "dense")
    stock = type(model).load(tmp_path / "dense.zip")
    assert stock.buffer_size == 777
    assert stock.optimize_memory_usage
    assert stock.replay_buffer_kwargs == kwargs
