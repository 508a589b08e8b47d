"""Outputs beside the action: estimates of the return, and what actions are sampled from."""

import subprocess

import numpy as np
import onnx
import onnxruntime
import pytest
import torch as th
from export.test_c import check_memory
from export.tools import COMPILER, Task
from gymnasium import spaces
from support import ALGORITHMS, DISCRETE, TinyDicts, TinyImages, make
from torch import nn

from sb3_sparse.errors import ConfigError, UnsupportedError
from sb3_sparse.export import ParityError, export_policy
from sb3_sparse.export.compiler import OPTIONS, compiled
from sb3_sparse.export.estimate import mean_quantiles
from sb3_sparse.export.extract import graph_of
from sb3_sparse.export.fold import fold
from sb3_sparse.export.numpy_policy import Policy
from sb3_sparse.export.parity import compare
from sb3_sparse.export.trace import Tracer

WRITTEN = ("c", "numpy", "onnx")
GAUSSIAN = ("PPO", "A2C", "TRPO", "SAC", "TQC", "CrossQ")


def observations_of(model, count=30):
    size = (count, *model.observation_space.shape)
    return np.random.default_rng(1).normal(size=size).astype(np.float32)


def outputs_of(path, to, seen):
    """All outputs of what was written, run as a user would."""
    if to == "numpy":
        found = Policy(path.with_suffix(".npz"))(seen)
        return found._asdict()
    session = onnxruntime.InferenceSession(path.with_suffix(".onnx"))
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, {"obs": seen}), strict=True))


def compiled_outputs(path, model, seen, **flags):
    graph = graph_of(model, None, **flags)
    columns = compiled(path.with_suffix(".c").read_text(), graph)(seen)
    ends = np.cumsum(list(graph.sizes.values()))
    return dict(zip(graph.sizes, np.split(columns, ends[:-1], axis=1), strict=True))


def expected_value(model, seen):
    """The estimate that an algorithm uses, by the modules of SB3; actions as it stores them."""
    policy, x = model.policy, th.as_tensor(seen)
    actions, _ = model.predict(seen, deterministic=True)
    name = type(model).__name__
    if name in ("PPO", "A2C", "TRPO"):
        return policy.predict_values(x)[:, 0]
    if name == "DQN":
        return policy.q_net(x)[range(len(seen)), actions]
    if name == "QRDQN":
        return policy.quantile_net(x)[range(len(seen)), :, actions].mean(dim=1)
    estimates = policy.critic(x, th.as_tensor(policy.scale_action(actions)))
    if name == "TQC":
        return estimates.reshape(len(seen), -1).mean(dim=1)
    return th.stack(estimates).min(dim=0).values[:, 0]


def expected_gaussian(model, seen):
    policy, x = model.policy, th.as_tensor(seen)
    if hasattr(policy, "get_distribution"):
        gaussian = policy.get_distribution(x).distribution
        return gaussian.mean, gaussian.stddev
    features = policy.actor.latent_pi(x)
    return policy.actor.mu(features), policy.actor.log_std(features).clamp(-20, 2).exp()


@pytest.mark.parametrize("compute", ["masked", "sparse"])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm(algorithm, compute, tmp_path):
    model = make(algorithm, policy_kwargs=dict(sparsity=0.7, compute=compute))
    model.learn(40)
    flags = dict(with_value=True, stochastic=algorithm in GAUSSIAN)
    seen = observations_of(model)
    expected = {"action": model.predict(seen, deterministic=True)[0]}
    with th.no_grad():
        expected["value"] = expected_value(model, seen).numpy()
        if algorithm in GAUSSIAN:
            mean, std = expected_gaussian(model, seen)
            expected |= {"mean": mean.numpy(), "std": std.numpy()}
    for to in WRITTEN:
        report = export_policy(model, tmp_path / "policy", to, **flags)
        assert report.parity.holds
        assert list(report.parity.further) == list(expected)[1:]
        if to == "c":
            found = compiled_outputs(tmp_path / "policy", model, seen, **flags)
        else:
            found = outputs_of(tmp_path / "policy", to, seen)
            assert {k: v.shape for k, v in found.items()} == {
                k: v.shape for k, v in expected.items()
            }
        assert list(found) == list(expected)
        for name, rows in expected.items():
            tolerance = 0 if (name, algorithm in DISCRETE) == ("action", True) else 1e-5
            np.testing.assert_allclose(
                found[name].reshape(rows.shape), rows, atol=tolerance, rtol=tolerance
            )
    assert np.ptp(expected["value"]) > 1e-3


@pytest.mark.parametrize("algorithm", ["DQN", "SAC", "PPO", "TD3", "TQC", "CrossQ", "QRDQN"])
def test_stock_policies(algorithm, tmp_path):
    model = make(algorithm, policy="MlpPolicy")
    flags = dict(with_value=True, stochastic=algorithm in GAUSSIAN)
    assert export_policy(model, tmp_path / "policy", "numpy", **flags).parity.holds
    found = outputs_of(tmp_path / "policy", "numpy", seen := observations_of(model))
    with th.no_grad():
        expected = expected_value(model, seen).numpy()
    np.testing.assert_allclose(found["value"], expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("algorithm", ["SAC", "TQC", "PPO", "QRDQN"])
def test_simba_networks(algorithm, tmp_path):
    model = make(algorithm, policy="SparseSimbaPolicy")
    flags = dict(with_value=True, stochastic=algorithm in GAUSSIAN)
    report = export_policy(model, tmp_path / "policy", "c", **flags)
    assert list(report.parity.further) == ["value", *["mean", "std"] * (algorithm in GAUSSIAN)]


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_a_shared_features_extractor_is_there_once(algorithm, share, tmp_path):
    kwargs = dict(share_features_extractor=share)
    model = make(algorithm, TinyImages(False), policy_kwargs=kwargs)
    graph = fold(graph_of(model, None, with_value=True, stochastic=True))
    assert sum(node.op == "conv" for node in graph.nodes) == (3 if share else 6)
    for to in WRITTEN:
        report = export_policy(model, tmp_path / "policy", to, with_value=True, stochastic=True)
        assert report.parity.holds


@pytest.mark.parametrize("algorithm", ["PPO", "DQN", "TD3"])
def test_dicts(algorithm, tmp_path):
    model = make(algorithm, TinyDicts(algorithm == "DQN"))
    for to in WRITTEN:
        assert export_policy(model, tmp_path / "policy", to, with_value=True).parity.holds


def test_critics_that_normalise_observations_far_from_zero(tmp_path):
    torque = spaces.Box(-1, 1, (1,), np.float32)
    model = make("CrossQ", Task(spaces.Box(999, 1001, (5,), np.float32), torque))
    norms = [model.policy.actor.latent_pi[0], *(q[0] for q in model.policy.critic.q_networks)]
    for norm in norms:
        norm.ra_mean[:5] = 1000.0
        norm.ra_var[:5] = 0.3
    for to in WRITTEN:
        parity = export_policy(model, tmp_path / "policy", to, with_value=True).parity
        assert parity.further["value"] < 1e-5


def test_eight_bit_weights(tmp_path):
    flags = dict(with_value=True, stochastic=True)
    report = export_policy(make("SAC"), tmp_path / "policy", "c", int8=True, **flags)
    assert max(report.parity.further.values()) < 1e-5
    assert 1e-5 < report.rounding.further["value"] < 0.02
    assert "; largest difference of value " in str(report)


@pytest.mark.parametrize("algorithm", ["SAC", "PPO", "QRDQN", "TQC"])
def test_no_value_is_overwritten_while_it_is_needed(algorithm):
    model = make(algorithm, policy_kwargs=dict(sparsity=0.5))
    check_memory(graph_of(model, None, True, algorithm in GAUSSIAN))


def test_without_the_options_there_is_the_action_alone(tmp_path):
    model = make("PPO")
    for to in WRITTEN:
        assert export_policy(model, tmp_path / "policy", to).parity.further == {}
    header = (tmp_path / "policy.h").read_text()
    assert "void sb3_sparse_policy(const float *obs, float *action);" in header
    assert "VALUE_SIZE" not in header
    assert len(onnx.load(tmp_path / "policy.onnx").graph.output) == 1
    with np.load(tmp_path / "policy.npz") as file:
        fields = {name for name in file.files if not name[0].isdigit()}
    assert fields == {"ops", "inputs", "observation", "action", "keys", "axes"}
    assert Policy(tmp_path / "policy.npz")(np.zeros(3)).shape == (1,)


@pytest.mark.parametrize("flag", ["with_value", "stochastic"])
def test_a_dense_zip_has_them_already(flag, tmp_path):
    with pytest.raises(ConfigError, match=f"{flag} is for c, numpy and onnx.*has its critics"):
        export_policy(make("SAC"), tmp_path / "policy", "dense", **{flag: True})


@pytest.mark.parametrize("flag", ["with_value", "stochastic"])
def test_whole_numbers_are_for_the_action_alone(flag, tmp_path):
    model = make("PPO")
    with pytest.raises(
        ConfigError, match=f"full' is for the action alone, .* with {flag}; give int8='weights'"
    ):
        export_policy(
            model, tmp_path / "policy", int8="full", observations=np.zeros((9, 3)), **{flag: True}
        )  # fmt: skip


def test_returns_are_of_the_action_alone(tmp_path):
    model = make("SAC")
    report = export_policy(
        model, tmp_path / "policy", int8="weights", with_value=True, eval_env=model.env
    )  # fmt: skip
    assert len(report.returns.int8) == 20


def test_a_policy_that_does_not_say_what_estimates_the_return(monkeypatch, tmp_path):
    model = make("DQN")
    monkeypatch.setattr(type(model.policy), "estimate", "")
    with pytest.raises(UnsupportedError, match="declare its class attribute estimate"):
        export_policy(model, tmp_path / "policy", with_value=True)


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_another_value_than_the_models_is_an_error(algorithm, monkeypatch, tmp_path):
    model = make(algorithm)
    if algorithm == "PPO":
        own = model.policy.predict_values
        monkeypatch.setattr(model.policy, "predict_values", lambda obs: own(obs) + 1)
    else:
        own = model.policy.critic.forward
        monkeypatch.setattr(
            model.policy.critic, "forward", lambda *given: tuple(q + 1 for q in own(*given))
        )
    assert export_policy(model, tmp_path / "policy").parity.holds  # it acts the same
    with pytest.raises(ParityError, match=r"largest difference of value (\d\.\de.0[01]) .allowed"):
        export_policy(model, tmp_path / "value", with_value=True)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".c", ".h"]


def test_differences_of_further_outputs_by_hand():
    def model(observations):
        return np.array([[0.5, 200.0, 0.0, 0.1]] * len(observations))

    def apart(*differences):
        return compare(
            model, lambda o: model(o) + differences, None, np.zeros((3, 1)), False, 0.0, sizes
        )  # fmt: skip

    sizes = {"value": 2, "std": 1}
    found = apart(0, 1e-4, 1.5e-3, 4e-7)
    assert found.further == pytest.approx({"value": 7.5e-6, "std": 4e-6})  # of 200, and of 0.1
    assert found.holds
    assert str(found) == (
        "largest difference 0.0e+00 on 3 random observations; largest difference of value 7.5e-06, "
        "std 4.0e-06"
    )
    for differences in ((0, 0, 3e-3, 0), (0, 0, 0, 2e-6), (2e-5, 0, 0, 0), (0, np.nan, 0, 0)):
        assert not apart(*differences).holds
    assert apart(0, 0, 0, np.inf).further["std"] == np.inf


def test_quantiles_that_no_linear_layer_makes_are_an_error():
    tracer = Tracer((6,), {})
    value = tracer.walk(nn.ReLU(), 0)
    with pytest.raises(UnsupportedError, match="does not end in a Linear layer.*; end it in one"):
        mean_quantiles(tracer, value, 3)


def test_a_small_standard_deviation_is_no_0():
    def model(observations):
        return np.array([[0.5, 2e-6]] * len(observations))

    for factor, difference in ((1.0, 0.0), (1 + 5e-6, 5e-6), (0.0, 1.0)):
        found = compare(
            model, lambda o, by=factor: model(o) * [1, by], None, np.zeros((3, 1)), False,
            further={"std": 1},
        )  # fmt: skip
        assert found.further == pytest.approx({"std": difference})
        assert found.holds == (difference < 1e-5)


def test_large_values_of_random_observations_hide_no_difference_of_recorded_ones():
    def model(observations):
        return np.concatenate([0 * observations, observations], axis=1)

    def apart(recorded, random):
        return compare(
            model, lambda o: model(o) + [0, 1e-3], recorded, random, False, further={"value": 1}
        )

    small, large = np.full((3, 1), 2.0), np.full((3, 1), 1e4)
    assert apart(None, large).holds
    assert apart(large, None).further == pytest.approx({"value": 1e-7})
    for pair in ((small, large), (large, small)):
        assert apart(*pair).further == pytest.approx({"value": 5e-4})
        assert not apart(*pair).holds


def test_a_main_function_can_sample(tmp_path):
    model = make("SAC")
    export_policy(model, tmp_path / "policy", "c", with_value=True, stochastic=True)
    (tmp_path / "main.c").write_text(
        """
        #include <stdio.h>
        #include "policy.h"
        int main(void) {
            float obs[SB3_SPARSE_OBSERVATION_SIZE] = {0.1f, -0.2f, 0.3f};
            float action[SB3_SPARSE_ACTION_SIZE], value[SB3_SPARSE_VALUE_SIZE];
            float mean[SB3_SPARSE_MEAN_SIZE], std[SB3_SPARSE_STD_SIZE];
            sb3_sparse_policy(obs, action, value, mean, std);
            printf("%.9g %.9g %.9g", (double)value[0], (double)mean[0], (double)std[0]);
            return 0;
        }
        """
    )
    program = tmp_path / "main"
    files = [str(tmp_path / "main.c"), str(tmp_path / "policy.c")]
    subprocess.run([COMPILER, *OPTIONS, *files, "-lm", "-o", str(program)], check=True)
    said = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    seen = np.float32([[0.1, -0.2, 0.3]])
    with th.no_grad():
        expected = [expected_value(model, seen), *expected_gaussian(model, seen)]
    np.testing.assert_allclose(
        [float(number) for number in said.split()], [x.item() for x in expected], atol=1e-5
    )
