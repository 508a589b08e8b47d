"""What is refused, and what is said."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from export.tools import VECTOR, OddExtractor, OwnExtractor, Task
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from support import make
from torch import nn

from sb3_sparse import RobustValueCallback, SparseActorCriticPolicy, SparsityCallback
from sb3_sparse.buffers import DynamicReplayBuffer
from sb3_sparse.errors import (
    ConfigError,
    Diverged,
    SparsityError,
    UnsupportedError,
)
from sb3_sparse.export import FORMATS, ParityError, export_policy, record_observations
from sb3_sparse.export.compiler import compiled
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.failure import failure_of
from sb3_sparse.export.fold import fold
from sb3_sparse.export.parity import Parity, compare
from sb3_sparse.export.quantize import quantized
from sb3_sparse.export.units import remove_dead_units
from sb3_sparse.export.written import of_graph

TORQUE = spaces.Box(-1, 1, (1,), np.float32)


@pytest.fixture(scope="module")
def model():
    return make("SAC")


def normalised(**arguments):
    envs = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), **arguments)
    model = make("SAC", envs)
    model.learn(60)
    return model


def written(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_normalisation_is_inside(to, tmp_path):
    model = normalised()
    report = export_policy(model, tmp_path / "policy", to)
    assert report.parity.holds
    if to == "c":
        act = compiled((tmp_path / "policy.c").read_text(), graph_of(model, None))
        raw = np.float32([[0.3, -0.9, 4.0], [1, 0, 0]])
        expected, _ = model.predict(
            model.get_vec_normalize_env().normalize_obs(raw), None, None, True
        )
        np.testing.assert_allclose(act(raw), expected, atol=1e-5)


def test_normalisation_far_from_zero_is_as_exact_as_near(tmp_path):
    model = normalised()
    rms = model.get_vec_normalize_env().obs_rms
    rms.mean, rms.var = np.array([1e4, -3e3, 0.1]), np.array([1e-6, 1e-4, 1.0])
    report = export_policy(model, tmp_path / "policy", "c")
    assert report.parity.difference < 1e-5
    assert "mean_1[3] = {\n    10000.0f, -3000.0f, 0.1f" in (tmp_path / "policy.c").read_text()


def test_statistics_may_be_given_as_a_file_or_an_object(tmp_path):
    model = normalised()
    normalization = model.get_vec_normalize_env()
    normalization.save(str(tmp_path / "vecnormalize.pkl"))
    model.env = model._vec_normalize_env = None
    contents = []
    for number, given in enumerate([normalization, tmp_path / "vecnormalize.pkl"]):
        export_policy(model, tmp_path / str(number), "c", vecnormalize=given)
        contents.append((tmp_path / f"{number}.c").read_bytes())
    assert contents[0] == contents[1]
    export_policy(model, tmp_path / "without", "c")
    assert (tmp_path / "without.c").read_bytes() != contents[0]


def test_normalisation_of_rewards_alone_is_none(tmp_path):
    export_policy(normalised(norm_obs=False), tmp_path / "policy", "c")
    assert "normalize" not in (tmp_path / "policy.c").read_text()


def test_statistics_of_another_environment_are_refused(model, tmp_path):
    other = VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")]))
    with pytest.raises(ConfigError, match=r"shape \(4,\), but those here have shape \(3,\)"):
        export_policy(model, tmp_path / "policy", "c", vecnormalize=other)
    for content in (pickle.dumps([1]), b"config: 1\nfoo\n", b"no pickle"):
        (tmp_path / "other.pkl").write_bytes(content)
        with pytest.raises(SparsityError, match="other.pkl .*give what VecNormalize.save wrote"):
            export_policy(model, tmp_path / "policy", "c", vecnormalize=tmp_path / "other.pkl")
    assert written(tmp_path) == ["other.pkl"]


def test_what_somebody_wrote_to_an_inactive_connection_is_not_exported(tmp_path):
    model = make("SAC", policy_kwargs=dict(compute="masked"))
    clean = export_policy(model, tmp_path / "clean", "numpy")
    layer = next(iter(model.policy.sparse.layers))
    flat = layer.weight.data.view(-1)
    flat[int(np.flatnonzero(~layer.mask())[0])] = 0.5
    written_to = export_policy(model, tmp_path / "written", "numpy")
    assert written_to.nnz == clean.nnz
    assert written_to.parity.holds


def test_weights_that_are_not_finite_are_refused(tmp_path):
    model = make("PPO", policy="MlpPolicy")
    model.policy.action_net.bias.data[0] = th.nan
    with pytest.raises(Diverged, match="values of action_net.bias are not finite"):
        export_policy(model, tmp_path / "policy")


@pytest.mark.parametrize("to", FORMATS)
def test_weights_that_are_not_float32_are_refused(to, tmp_path):
    model = make("PPO", policy="MlpPolicy")
    model.policy.double()
    with pytest.raises(UnsupportedError, match=r"is of torch.float64.*policy.float\(\) before"):
        export_policy(model, tmp_path / "policy", to)


def test_a_dense_zip_that_stock_sb3_cannot_load_is_not_written(tmp_path):
    model = make("TD3", policy="MlpPolicy")
    nn.utils.parametrizations.spectral_norm(model.policy.actor.mu[0])
    with pytest.raises(ParityError, match="cannot load the policy.*parametrized or replaced later"):
        export_policy(model, tmp_path / "policy", "dense", force=True)
    assert written(tmp_path) == []
    assert export_policy(model, tmp_path / "policy", "c").parity.holds


@pytest.mark.parametrize("compute", ["masked", "sparse"])
def test_a_model_that_rlx2_trained_is_a_dense_zip_with_sb3s_buffer(compute, tmp_path):
    model = make("SAC", policy_kwargs=dict(compute=compute))
    rlx2 = [SparsityCallback("rigl", update_interval=5), RobustValueCallback(check_interval=10)]
    model.learn(40, rlx2)
    assert export_policy(model, tmp_path / "policy", "dense").parity.holds
    stock = type(model).load(tmp_path / "policy.zip", env=model.get_env())
    assert type(stock.replay_buffer) is ReplayBuffer
    stock.learn(40)


def test_a_dense_zip_keeps_the_steps_of_returns(tmp_path):
    arguments = dict(replay_buffer_class=DynamicReplayBuffer, replay_buffer_kwargs={"n_steps": 4})
    export_policy(make("SAC", **arguments), tmp_path / "policy", "dense")
    buffer = SAC.load(tmp_path / "policy.zip").replay_buffer
    assert type(buffer) is NStepReplayBuffer
    assert buffer.n_steps == 4


def test_other_algorithms_are_refused(tmp_path):
    model = RecurrentPPO("MlpLstmPolicy", "CartPole-v1")
    with pytest.raises(UnsupportedError, match="a model of RecurrentPPO cannot be exported.*SAC"):
        export_policy(model, tmp_path / "policy")


def test_networks_that_do_anything_else_are_refused(tmp_path):
    kwargs = dict(features_extractor_class=OddExtractor)
    model = make("PPO", Task(VECTOR, spaces.Discrete(2)), policy_kwargs=kwargs)
    with pytest.raises(UnsupportedError, match=r"\(OddExtractor\) .*norm.*allowed are Linear"):
        export_policy(model, tmp_path / "policy")


def test_arguments_are_checked(model, tmp_path):
    with pytest.raises(ConfigError, match="unknown export format 'tflite'; allowed are c, numpy"):
        export_policy(model, tmp_path / "policy", "tflite")
    with pytest.raises(ConfigError, match="int8 is for to='c' only, got to='onnx'"):
        export_policy(model, tmp_path / "policy", "onnx", int8=True)
    with pytest.raises(ConfigError, match=r"must end in .onnx, got .*policy.c"):
        export_policy(model, tmp_path / "policy.c", "onnx")
    with pytest.raises(ConfigError, match=r"of shape \(3,\).*got an array of shape \(5, 4\)"):
        export_policy(model, tmp_path / "policy", observations=np.zeros((5, 4)))
    assert written(tmp_path) == []


def test_where_files_go(model, tmp_path):
    export_policy(model, tmp_path, "c")
    export_policy(model, str(tmp_path / "new" / "walk.c"), "c")
    export_policy(model, tmp_path / "new" / "walk", "numpy")
    assert written(tmp_path) == ["new", "policy.c", "policy.h"]
    assert written(tmp_path / "new") == ["numpy_policy.py", "walk.c", "walk.h", "walk.npz"]


def broken(monkeypatch):
    """Exports whose last bias is wrong."""
    from sb3_sparse.export import written

    def wrong(graph):
        layer = graph.layers[-1]
        layer.bias[0] += 0.25
        return graph

    monkeypatch.setattr(written, "remove_dead_units", wrong)


@pytest.mark.parametrize("to", ["c", "numpy", "onnx"])
def test_what_acts_otherwise_is_not_written_unless_forced(model, to, monkeypatch, tmp_path):
    broken(monkeypatch)
    with pytest.raises(ParityError, match="does not act as the model: .*difference .*allowed"):
        export_policy(model, tmp_path / "policy", to)
    assert written(tmp_path) == []
    report = export_policy(model, tmp_path / "policy", to, force=True)
    assert written(tmp_path)
    assert not report.parity.holds
    assert "note: written although it does not act as the model" in str(report)


def test_a_discrete_action_that_differs_is_told_with_the_gap_of_the_scores(monkeypatch, tmp_path):
    broken(monkeypatch)
    model = make("PPO", "CartPole-v1")
    with pytest.raises(ParityError, match=r"actions differ for \d+ of 1000.*are .* apart in score"):
        export_policy(model, tmp_path / "policy")


def test_scores_that_are_told_are_those_of_rounded_weights():
    raw = graph_of(make("PPO", "CartPole-v1"), None)
    many = np.random.default_rng(0).normal(size=(100, 4)).astype(np.float32)
    scores = raw.values(many)[raw.action.inputs[0]]
    seen = many[[np.abs(scores[0] - scores[1]).argmin()]]
    said = {}
    for int8 in (None, "weights"):
        graph = of_graph(raw, "c", int8, None, None).graph
        text = failure_of(Parity(0, 1, 1.0, 1, True, seen), graph)
        said[int8] = float(text.removesuffix(" apart in score").rpartition(" ")[2])
    for int8, graph in ((None, raw), ("weights", quantized(remove_dead_units(fold(raw))))):
        left, right = graph.values(seen)[graph.action.inputs[0]][:, 0]
        assert said[int8] == float(f"{abs(left - right):.1e}")
    assert said["weights"] != said[None]


def test_parity_by_hand():
    def model(observations):
        return np.array([[0.0, 100.0]] * len(observations))

    def other(observations):
        return model(observations) + [[3e-6, 5e-4]]

    found = compare(model, other, np.zeros((70, 1)), np.zeros((3, 1)), False)
    assert found.difference == pytest.approx(5e-6)  # 5e-4 of 100
    assert found.holds
    assert (found.recorded, found.random) == (70, 3)
    assert str(found) == "largest difference 5.0e-06 on 70 recorded and 3 random observations"
    assert not compare(model, lambda o: model(o) + 2e-5, None, np.zeros((3, 1)), False).holds
    assert not compare(model, lambda o: model(o) * np.nan, None, np.zeros((3, 1)), False).holds
    found = compare(model, other, None, np.zeros((3, 1)), True)
    assert found.different == 3
    assert not found.holds


def test_rounding_may_grow_with_the_range_that_actions_are_squashed_into(tmp_path):
    wide = spaces.Box(np.float32([-1e6, -1]), np.float32([1e6, 1]))
    for algorithm in ("SAC", "TD3"):
        for to in ("c", "numpy", "onnx"):
            report = export_policy(make(algorithm, Task(VECTOR, wide)), tmp_path / "policy", to)
            assert report.parity.holds
    span = np.array([1e6, 1.0])
    for off, holds in (([5.0, 0], True), ([15.0, 0], False), ([0, 5e-6], True), ([0, 2e-5], False)):
        found = compare(
            lambda o: np.zeros((len(o), 2)), lambda o, off=off: np.zeros((len(o), 2)) + off,
            None, np.zeros((3, 1)), False, span,
        )  # fmt: skip
        assert found.holds == holds


def test_without_a_compiler_a_c_file_is_written_only_when_forced(model, monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(UnsupportedError, match="there is no no-such-compiler here; install gcc"):
        export_policy(model, tmp_path / "policy")
    assert written(tmp_path) == []
    report = export_policy(model, tmp_path / "policy", force=True)
    assert report.parity is None
    assert "parity: not checked" in str(report)
    assert "written unchecked, as you asked" in str(report)
    assert written(tmp_path) == ["policy.c", "policy.h"]


def test_the_report_counts(tmp_path):
    model = make("SAC", policy_kwargs=dict(sparsity=0.9))
    report = export_policy(model, tmp_path / "policy", "c")
    acting = ("actor.latent", "actor.mu")
    masks = [la.mask() for la in model.policy.sparse.layers if la.name.startswith(acting)]
    assert report.nnz == sum(int(mask.sum()) for mask in masks)
    assert report.dense_bytes == 4 * (3 * 24 + 24 + 24 * 24 + 24 + 24 + 1)
    assert report.units == 24 + 24 + 1
    assert 0 < report.removed_units < report.units
    assert 0 < report.exported_nnz < report.nnz
    assert report.files[tmp_path / "policy.c"] == (tmp_path / "policy.c").stat().st_size
    assert f"connections: {report.nnz}, exported {report.exported_nnz}" in str(report)


def test_recorded_observations_are_what_the_environment_showed():
    model = normalised()
    envs = model.get_env()
    before = envs.obs_rms.mean.copy()
    found = record_observations(model, envs, 30)
    assert found.shape == (30, 3)
    np.testing.assert_allclose(found[:, 0] ** 2 + found[:, 1] ** 2, 1, rtol=1e-5)  # raw angles
    np.testing.assert_array_equal(envs.obs_rms.mean, before)
    assert envs.training


def test_recorded_images_are_channels_first(tmp_path):
    model = make("PPO", "TinyImages-v0")
    plain = DummyVecEnv([lambda: gym.make("TinyImages-v0")])
    found = record_observations(model, plain, 5)
    assert found.shape == (5, 1, 36, 36)
    assert export_policy(model, tmp_path / "policy", observations=found).parity.recorded == 5


def test_a_model_that_saw_normalised_observations_needs_the_statistics(tmp_path):
    envs = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    trained = make("PPO", envs)
    trained.learn(40)
    envs.save(str(tmp_path / "statistics.pkl"))
    trained.save(tmp_path / "model.zip")
    alone = type(trained).load(tmp_path / "model.zip")
    with pytest.raises(ConfigError, match="under a VecNormalize.*--vecnormalize FILE"):
        export_policy(alone, tmp_path / "policy")
    report = export_policy(alone, tmp_path / "policy", vecnormalize=tmp_path / "statistics.pkl")
    assert report.parity.holds
    plain = make("PPO")
    plain.learn(40)
    assert export_policy(plain, tmp_path / "plain").parity.holds


def test_frames_that_are_stacked_after_normalisation(tmp_path):
    envs = VecFrameStack(VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")])), 2)
    model = make("PPO", envs)
    with pytest.raises(ConfigError, match=r"shape \(3,\).*shape \(6,\).*'dense' only"):
        export_policy(model, tmp_path / "policy")
    seen = record_observations(model, envs, 20)
    assert seen.shape == (20, 6)
    report = export_policy(model, tmp_path / "policy", "dense", observations=seen)
    assert "does not normalise" in str(report)
    with pytest.raises(ConfigError, match="'dense' only"):
        export_policy(model, tmp_path / "policy", observations=seen)


def test_an_environment_of_other_actions_is_refused(model):
    env = DummyVecEnv([lambda: Task(model.observation_space, spaces.Discrete(2))])
    with pytest.raises(ConfigError, match=r"takes actions in Discrete\(2\), the model chooses"):
        record_observations(model, env, 5)


def test_bounds_without_end_are_the_largest_floats_in_c(tmp_path):
    model = normalised(clip_obs=np.inf)
    for to in ("c", "numpy", "onnx"):
        assert export_policy(model, tmp_path / "policy", to).parity.holds
    assert "3.4028235e+38f" in (tmp_path / "policy.c").read_text()


def test_batch_normalisation_of_observations_far_from_zero(tmp_path):
    model = make("CrossQ", Task(spaces.Box(999, 1001, (5,), np.float32), TORQUE))
    norm = model.policy.actor.latent_pi[0]
    norm.ra_mean.fill_(1000.0)
    norm.ra_var.fill_(0.3)
    for to in ("c", "numpy", "onnx"):
        assert export_policy(model, tmp_path / "policy", to).parity.difference < 1e-5


class Scaled(OwnExtractor):
    def forward(self, observations):
        features = self.first(observations)
        return th.add(features, self.second(features), alpha=0.5)


class InPlace(OwnExtractor):
    def forward(self, observations):
        features = self.first(observations)
        return features + nn.functional.relu(self.inplace(features))

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.inplace = nn.ReLU(inplace=True)


class Rows(OwnExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.rows = nn.Sequential(nn.Linear(5, 4), nn.Flatten())

    def forward(self, observations):
        return self.rows(observations)


@pytest.mark.parametrize(
    ("extractor", "shape", "message"),
    [
        (Scaled, (5,), r"\(Scaled\) cannot be exported.*add\(alpha=0.5\)"),
        (InPlace, (5,), "changes a value in place.*build it with inplace=False"),
        (Rows, (4, 5), r"rows.0 \(Linear\) cannot be exported: it takes a value of shape \(4, 5\)"),
    ],
)
def test_networks_that_would_be_misread_are_refused(extractor, shape, message, tmp_path):
    env = Task(spaces.Box(-1, 1, shape, np.float32), spaces.Discrete(2))
    model = make("PPO", env, policy_kwargs=dict(features_extractor_class=extractor))
    with pytest.raises(UnsupportedError, match=message):
        export_policy(model, tmp_path / "policy")


class OwnPolicy(ActorCriticPolicy):
    pass


class OwnSparsePolicy(SparseActorCriticPolicy):
    pass


def test_dense_zips_keep_policy_classes_of_ones_own(tmp_path):
    export_policy(PPO(OwnPolicy, "CartPole-v1", device="cpu"), tmp_path / "own", "dense")
    assert type(PPO.load(tmp_path / "own.zip").policy) is OwnPolicy
    model = PPO(OwnSparsePolicy, "CartPole-v1", device="cpu", policy_kwargs=dict(sparsity=0.5))
    with pytest.raises(UnsupportedError, match="OwnSparsePolicy is your own sparse policy"):
        export_policy(model, tmp_path / "sparse", "dense")


@pytest.mark.parametrize("tool", ["false", "cc -m32"])
def test_a_compiler_that_is_no_use_is_named(model, tool, monkeypatch, tmp_path):
    monkeypatch.setenv("CC", tool)
    with pytest.raises(UnsupportedError, match="in CC, or write it unchecked"):
        export_policy(model, tmp_path / "policy")
    assert written(tmp_path) == []


def test_all_files_are_written_or_none(model, tmp_path):
    (tmp_path / "policy.h").mkdir()
    with pytest.raises(ConfigError, match="policy.h is a folder"):
        export_policy(model, tmp_path / "policy.c")
    assert written(tmp_path) == ["policy.h"]


def test_broken_sensors_are_not_hidden(model, tmp_path):
    export_policy(model, tmp_path / "policy", "c")
    act = compiled((tmp_path / "policy.c").read_text(), graph_of(model, None))
    broken = np.full((1, 3), np.nan, np.float32)
    used = model.policy.actor.latent_pi[0].state_dict()["weight"].any()
    assert used
    assert np.isnan(act(broken)).all()


def test_recorded_observations_that_are_not_finite_are_refused(model, tmp_path):
    with pytest.raises(ConfigError, match="must be finite"):
        export_policy(model, tmp_path / "policy", observations=np.full((2, 3), np.nan))
