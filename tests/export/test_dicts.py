"""Observations in a dict, of any number of keys, and models of hindsight experience replay."""

import numpy as np
import onnxruntime
import pytest
import torch as th
from export.tools import VECTOR, Task
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from support import make
from torch import nn

from sb3_sparse import sparsify
from sb3_sparse.errors import ConfigError, UnsupportedError
from sb3_sparse.export import FORMATS, export_policy, record_observations
from sb3_sparse.export.compiler import compiled
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.fold import fold
from sb3_sparse.export.graph import Graph
from sb3_sparse.export.nodes import Concat, Positive, Slice
from sb3_sparse.export.numpy_policy import Policy
from sb3_sparse.export.reference import predictor
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
    report = export_policy(model, tmp_path / "dense", "dense", observations=seen)
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
    report = export_policy(model, tmp_path / "dense", "dense")
    assert report.parity.holds
    assert report.parity.random == 100
    seen = record_observations(model, DummyVecEnv([lambda: model.env.envs[0].unwrapped]), 5)
    assert seen["image"].shape == (5, 1, 36, 36)
    for to in FORMATS:
        report = export_policy(model, tmp_path / to, to, observations=seen)
        assert report.parity.holds
        assert report.parity.recorded == 5


@pytest.mark.parametrize(
    ("algorithm", "keys"),
    [
        *(("SAC", keys) for keys in (1, 2, 3, 4, 5)),
        *((name, keys) for name in ("DQN", "PPO") for keys in (2, 5)),
        *((name, 5) for name in ("TD3", "TQC", "QRDQN", "CrossQ")),
    ],
)
def test_every_other_format_acts_as_the_model(algorithm, keys, tmp_path):
    action = THREE if algorithm in ("DQN", "QRDQN") else TORQUE
    model = make(algorithm, Task(dicts(keys), action), policy_kwargs=dict(sparsity=0.6))
    seen = samples(model.observation_space, 7)
    for to in ("c", "numpy", "onnx"):
        report = export_policy(model, tmp_path / "policy", to, observations=seen)
        assert report.parity.holds
        assert (report.parity.recorded, report.parity.random) == (7, 1000)
    assert export_policy(model, tmp_path / "int8", "c", int8=True).parity.holds


@pytest.fixture(scope="module")
def mixed():
    """Five kinds of parts and an image; the policy, observations and its actions."""
    space = spaces.Dict({**PARTS, "eye": spaces.Box(0, 255, (36, 36, 3), np.uint8)})
    model = make("PPO", Task(space, TORQUE), policy_kwargs=dict(sparsity=0.6))
    model.policy.action_net.weight.data.mul_(50)
    seen = samples(model.observation_space, 6)
    return model, seen, model.predict(seen, deterministic=True)[0]


def test_numpy_takes_one_dict_or_many(mixed, tmp_path):
    model, seen, expected = mixed
    export_policy(model, tmp_path / "policy", "numpy")
    policy = Policy(tmp_path / "policy.npz")
    np.testing.assert_allclose(policy(seen), expected, atol=1e-5)
    one = policy({key: part[2] for key, part in seen.items()})
    np.testing.assert_allclose(one, expected[2], atol=1e-5)
    as_it_is = {**seen, "one of five": [int(n) for n in seen["one of five"]]}
    np.testing.assert_allclose(policy(as_it_is), expected, atol=1e-5)


def test_onnx_has_an_input_for_each_key(mixed, tmp_path):
    model, seen, expected = mixed
    export_policy(model, tmp_path / "policy", "onnx")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    asked = {one.name: (one.type, tuple(one.shape)) for one in session.get_inputs()}
    assert asked["eye"] == ("tensor(uint8)", ("batch", 3, 36, 36))
    assert asked["one of five"] == ("tensor(float)", ("batch", 1))
    assert asked["matrix"] == ("tensor(float)", ("batch", 2, 3))
    given = {key: part.astype(np.float32) for key, part in seen.items()}
    given |= {"eye": seen["eye"], "one of five": given["one of five"][:, None]}
    np.testing.assert_allclose(session.run(None, given)[0], expected, atol=1e-5)


def test_c_takes_the_parts_behind_each_other_in_the_order_that_it_names(mixed, tmp_path):
    model, seen, expected = mixed
    export_policy(model, tmp_path / "policy", "c")
    text = (tmp_path / "policy.h").read_text().replace("\n * ", " ")
    order = sorted(model.observation_space.spaces)  # as gymnasium has it
    assert order == ["choices", "eye", "matrix", "one of five", "switches", "vector"]
    assert (
        "3909 numbers: 'choices' (3), then 'eye' (3x36x36), then 'matrix' (2x3), then "
        "'one of five' (1), then 'switches' (4), then 'vector' (7), raw" in text
    )
    assert 3 + 3 * 36 * 36 + 6 + 1 + 4 + 7 == 3909
    assert "SB3_SPARSE_OBSERVATION_SIZE 3909" in text
    rows = np.concatenate([seen[key].reshape(6, -1) for key in order], axis=1)
    act = compiled((tmp_path / "policy.c").read_text(), Graph((3909,), (Positive((0,), (2,)),)))
    np.testing.assert_allclose(act(rows.astype(np.float32)), expected, atol=1e-5)


@pytest.mark.parametrize("to", ["c", "numpy", "onnx", "dense"])
@pytest.mark.parametrize("algorithm", ["DQN", "PPO", "SAC"])
@pytest.mark.parametrize("space", [spaces.Discrete(6), spaces.MultiDiscrete([3, 4])], ids=str)
def test_numbers_of_states_are_one_hot_inside(space, algorithm, to, tmp_path):
    action = THREE if algorithm == "DQN" else TORQUE
    model = make(algorithm, Task(space, action), policy_kwargs=dict(sparsity=0.5))
    assert export_policy(model, tmp_path / "policy", to).parity.holds
    if to == "numpy":
        state = 4 if isinstance(space, spaces.Discrete) else np.array([2, 3])
        expected, _ = model.predict(np.array(state), deterministic=True)
        np.testing.assert_allclose(
            Policy(tmp_path / "policy.npz")(state), np.reshape(expected, action.shape), atol=1e-5
        )


class OwnCombination(BaseFeaturesExtractor):
    """As SB3's documentation shows it, by hand."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=8 + 5)
        self.first = nn.Sequential(nn.Linear(7, 8), nn.GELU())

    def forward(self, observations):
        vector, one = observations["vector"], observations["one of five"]
        return th.cat((one, self.first(vector / 2.0)), dim=1)


@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_a_combination_of_ones_own(to, tmp_path):
    kwargs = dict(features_extractor_class=OwnCombination)
    model = make("PPO", Task(dicts(2), TORQUE), "MultiInputPolicy", policy_kwargs=kwargs)
    assert export_policy(model, tmp_path / "policy", to).parity.holds


class Backwards(OwnCombination):
    def forward(self, observations):
        return th.cat([observations["b"], observations["a"]], dim=1)

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self._features_dim = 4


def test_parts_in_another_order_are_not_taken_for_the_observation(tmp_path):
    space = spaces.Dict({key: spaces.Box(-1, 1, (2,), np.float32) for key in "ab"})
    kwargs = dict(features_extractor_class=Backwards)
    model = make("PPO", Task(space, TORQUE), "MultiInputPolicy", policy_kwargs=kwargs)
    for to in ("c", "numpy", "onnx"):
        assert export_policy(model, tmp_path / "policy", to).parity.holds


def test_parts_that_are_passed_on_as_they_are_cost_nothing(tmp_path):
    space = spaces.Dict({"a": PARTS["vector"], "b": PARTS["switches"], "c": PARTS["matrix"]})
    model = make("SAC", Task(space, TORQUE))
    graph = fold(graph_of(model, None))
    assert graph.observation_shape == (7 + 4 + 6,)
    assert not [node for node in graph.nodes if isinstance(node, (Slice, Concat))]


def test_dicts_that_cannot_be_exported_are_refused(tmp_path):
    grid = spaces.MultiDiscrete([[2, 3], [4, 5]])
    model = make("PPO", Task(VECTOR, TORQUE))
    model.observation_space = spaces.Dict(a=PARTS["vector"], grid=grid)
    with pytest.raises(UnsupportedError, match=r"MultiDiscrete \(of one axis\)"):
        export_policy(model, tmp_path / "policy")


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
            export_policy(model, tmp_path / "dense", "dense", observations=wrong)


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
    for to in FORMATS:
        report = export_policy(model, tmp_path / to, to, observations=seen)
        assert report.parity.holds
        assert ("does not normalise" in str(report)) == (to == "dense")
    policy = Policy(tmp_path / "numpy.npz")
    raw = samples(space, 5)
    expected, _ = model.predict(normalised.normalize_obs(raw), deterministic=True)
    np.testing.assert_allclose(policy(raw), expected, atol=1e-5)
    other = VecNormalize(DummyVecEnv([lambda: Task(dicts(1), TORQUE)]))
    wrong = r"shape \(7,\), but those here have shape \(7,\), \(2,\)"
    with pytest.raises(ConfigError, match=wrong):
        export_policy(model, tmp_path / "other", "c", vecnormalize=other)
    stacked = VecFrameStack(VecNormalize(DummyVecEnv([lambda: Task(space, TORQUE)])), 3)
    model = make("PPO", stacked)
    seen = record_observations(model, stacked, 10)
    assert {key: part.shape for key, part in seen.items()} == {"a": (10, 21), "b": (10, 6)}
    assert (
        export_policy(model, tmp_path / "stacked", "dense", observations=seen).parity.recorded == 10
    )
    with pytest.raises(ConfigError, match="'dense' only"):
        export_policy(model, tmp_path / "stacked", "c", observations=seen)


def hindsight(algorithm, **arguments):
    env = BitFlippingEnv(n_bits=4, continuous=algorithm != "DQN", max_steps=4)
    arguments |= dict(replay_buffer_class=HerReplayBuffer, buffer_size=500, learning_starts=8)
    model = make(algorithm, env, replay_buffer_kwargs=dict(n_sampled_goal=2), **arguments)
    model.learn(24)
    return model


@pytest.mark.parametrize("algorithm", ["DQN", "SAC", "TD3", "TQC"])
def test_models_of_hindsight_experience_replay(algorithm, tmp_path):
    model = hindsight(algorithm)
    assert export_policy(model, tmp_path / "dense", "dense").parity.holds
    model.save(tmp_path / "model.zip")
    alone = load_without_buffer(type(model), tmp_path / "model.zip")
    assert alone.env is None
    assert alone.replay_buffer is None
    for to in FORMATS:
        assert export_policy(alone, tmp_path / "again", to).parity.holds
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
    export_policy(alone, tmp_path / "dense", "dense")
    stock = type(model).load(tmp_path / "dense.zip")
    assert stock.buffer_size == 777
    assert stock.optimize_memory_usage
    assert stock.replay_buffer_kwargs == kwargs
