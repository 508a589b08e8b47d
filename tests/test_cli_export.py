from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file
from support import command, make

from sb3_sparse.errors import ConfigError
from sb3_sparse.export.numpy_policy import Policy
from sb3_sparse.zoo.saved import SavedModel
from sb3_sparse.zoo.saved_by import algos_of
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import train

QUICK = dict(n_timesteps=300, eval_freq=100, eval_episodes=2)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    settings = dict(normalize=True, n_steps=64, batch_size=32, net_arch=[16, 16])
    run = RunSpec(
        algo="ppo", env_id="Pendulum-v1", method="set", sparsity=0.5, hyperparams=settings, **QUICK
    )
    return train(run, tmp_path_factory.mktemp("logs")).folder


@pytest.mark.parametrize("to", ["c", "numpy", "onnx", "dense"])
def test_a_run_is_exported_with_its_normalisation(run_folder, to, monkeypatch, capsys, tmp_path):
    code, said = command(monkeypatch, capsys, "export", run_folder, "--to", to, tmp_path / "p")
    assert code == 0, said
    assert "1000 recorded and 1000 random observations" in said
    if to == "numpy":
        saved = SavedModel.find(run_folder)
        model, policy = saved.load(), Policy(tmp_path / "p.npz")
        normalization = pickle.loads(saved.vecnormalize.read_bytes())
        raw = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
        expected, _ = model.predict(normalization.normalize_obs(raw), deterministic=True)
        np.testing.assert_allclose(policy(raw), expected, atol=1e-5)
        assert not np.allclose(policy(raw), model.predict(raw, deterministic=True)[0], atol=1e-3)


def test_a_run_is_exported_with_its_value_and_distribution(
    run_folder, monkeypatch, capsys, tmp_path
):
    arguments = ["export", run_folder, "--to", "numpy", tmp_path / "p"]
    code, said = command(monkeypatch, capsys, *arguments, "--with-value", "--stochastic")
    assert code == 0, said
    assert "1000 recorded and 1000 random observations; largest difference of value" in said
    saved = SavedModel.find(run_folder)
    model, policy = saved.load(), Policy(tmp_path / "p.npz")
    normalization = pickle.loads(saved.vecnormalize.read_bytes())
    raw = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    seen = th.as_tensor(normalization.normalize_obs(raw))
    found = policy(raw)
    assert found._fields == ("action", "value", "mean", "std")
    expected = model.policy.predict_values(seen).detach()[:, 0]
    np.testing.assert_allclose(found.value, expected, atol=1e-5)
    std = model.policy.log_std.exp().detach().expand(9, 1)
    np.testing.assert_allclose(found.std, std, atol=1e-6)


def test_a_zip_in_a_run_folder_knows_its_run(run_folder, monkeypatch, capsys, tmp_path):
    for arguments in ([run_folder / "best_model.zip"], [run_folder, "--best"]):
        code, said = command(
            monkeypatch, capsys, "export", *arguments, tmp_path / "policy.onnx", "--to", "onnx"
        )
        assert code == 0, said
        assert "1000 recorded" in said
    assert SavedModel.find(run_folder / "best_model.zip").vecnormalize is not None
    assert SavedModel.find(run_folder / "best_model").path.suffix == ".zip"


def test_missing_statistics_are_an_error(run_folder, monkeypatch, capsys, tmp_path):
    statistics = run_folder / "Pendulum-v1" / "vecnormalize.pkl"
    elsewhere = statistics.rename(tmp_path / "elsewhere.pkl")
    try:
        code, said = command(monkeypatch, capsys, "export", run_folder, tmp_path / "policy")
        assert code == 2
        assert "normalised its observations" in said
        assert "give the statistics with --vecnormalize FILE" in said
        assert not (tmp_path / "policy.c").exists()
        code, said = command(
            monkeypatch,
            capsys,
            "export",
            run_folder,
            tmp_path / "policy",
            "--vecnormalize",
            elsewhere,
        )
        assert code == 0, said
    finally:
        elsewhere.rename(statistics)


def test_an_export_does_not_overwrite_its_model(monkeypatch, capsys, tmp_path):
    make("DQN").save(tmp_path / "model.zip")
    before = (tmp_path / "model.zip").read_bytes()
    for out in ("model", "model.zip"):
        code, said = command(
            monkeypatch, capsys, "export", tmp_path / "model.zip", tmp_path / out, "--to", "dense"
        )
        assert code == 2
        assert "would be overwritten by its own export" in said
    assert (tmp_path / "model.zip").read_bytes() == before


def test_a_zip_of_a_normalised_run_alone_needs_its_statistics(
    run_folder, monkeypatch, capsys, tmp_path
):
    alone = shutil.copy(run_folder / "Pendulum-v1.zip", tmp_path / "alone.zip")
    for arguments in (["export", alone], ["compress", alone, "--env", "Pendulum-v1"]):
        code, said = command(monkeypatch, capsys, *arguments)
        assert code == 2
        assert "was trained with VecNormalize; give its statistics with --vecnormalize FILE" in said


def test_a_zip_alone(monkeypatch, capsys, tmp_path):
    make("DQN", policy="MlpPolicy").save(tmp_path / "model.zip")
    zip_file = tmp_path / "model.zip"
    code, said = command(monkeypatch, capsys, "export", zip_file, tmp_path / "policy", "--int8")
    assert code == 0, said
    assert "no observations were recorded; --env ID" in said
    assert "int8 against float32" in said
    code, said = command(
        monkeypatch, capsys, "export", zip_file, tmp_path / "policy", "--env", "CartPole-v1"
    )
    assert code == 0, said
    assert "1000 recorded" in said


def test_int8_with_and_without_a_value(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    make("DQN", policy="MlpPolicy").save("model.zip")
    full = ["--int8", "full", "--env", "CartPole-v1"]
    code, said = command(monkeypatch, capsys, "export", "model.zip", *full, "whole")
    assert code == 0, said
    assert "int8 against float32: actions differ for" in said
    assert "of 1000 recorded observations" in said
    assert "20 episodes with the same seeds" in said
    assert "int16_t whole[" in Path("whole.c").read_text()
    for words in (["--int8", "one"], ["two", "--int8"], ["three", "--int8=weights"]):
        code, said = command(monkeypatch, capsys, "export", "model.zip", *words)
        assert code == 0, said
        assert "episodes" not in said
    assert Path("one.c").read_text() == Path("two.c").read_text() == Path("three.c").read_text()
    assert "whole[" not in Path("one.c").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["no.zip"], "there is no file"),
        (
            ["model.zip", "--to", "tflite"],
            "unknown export format 'tflite'; allowed are c, numpy, onnx, dense",
        ),
        (["model.zip", "--to", "onnx", "--int8"], "int8 is for to='c' only"),
        (["model.zip", "--int8=most"], "unknown value of int8 'most'; allowed are weights, full"),
        (["model.zip", "--int8", "full"], "recorded observations; give observations"),
        (["model.zip", "--to", "dense", "--with-value"], "with_value is for c, numpy and onnx"),
        (["model.zip", "--stochastic"], "SparseDQNPolicy has no distribution of actions"),
        (["model.zip", "--vecnormalize", "no.pkl"], "there is no file no.pkl; give what"),
        (["model.zip", "--algo", "sac"], "model.zip is a model of dqn, not of sac; leave --algo"),
        (["model.zip", "--algo", "dreamer"], "unknown algorithm 'dreamer'; allowed are dqn"),
        (["model.zip", "--env", "NoSuch-v0"], "NoSuch"),
        (
            ["model.zip", "--env", "Pendulum-v1"],
            "shows observations of shape (3,), the model takes",
        ),
        (["model.zip", "--env", "TinyImages-v0"], "observations of shape (36, 36, 1), the model"),
        (["broken.zip"], "holds no model saved by SB3"),
        (["masks.zip"], "masks and weights disagree"),
        (["."], "there is no run in"),
    ],
)
def test_mistakes_are_one_line(arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    model = make("DQN")
    model.save("model.zip")
    (tmp_path / "broken.zip").write_text("nothing")
    data, params, variables = load_from_zip_file("model.zip")
    weight, mask = (params["policy"][f"q_net.q_net.0.{n}"] for n in ("weight", "weight_mask"))
    weight[~mask.bool()] = 1.0
    save_to_zip_file("masks.zip", data, params, variables)
    model_file, *rest = arguments
    code, said = command(monkeypatch, capsys, "export", model_file, "policy", *rest)
    assert code == 2
    assert message in said
    assert said.startswith("Error:")
    assert not list(tmp_path.glob("policy*"))


@pytest.mark.parametrize(
    "algorithm", ["DQN", "QRDQN", "SAC", "TQC", "CrossQ", "TD3", "PPO", "A2C", "TRPO"]
)
@pytest.mark.parametrize("policy", ["SparsePolicy", "MlpPolicy"])
def test_a_file_tells_its_algorithm(algorithm, policy, tmp_path):
    make(algorithm, policy=policy).save(tmp_path / "model.zip")
    assert algos_of(tmp_path / "model.zip")[0] == algorithm.lower()


def test_a_recurrent_policy_is_not_taken_for_one_of_ppo(tmp_path):
    RecurrentPPO("MlpLstmPolicy", "CartPole-v1", device="cpu").save(tmp_path / "model.zip")
    with pytest.raises(ConfigError, match="belongs to no supported algorithm; allowed are dqn"):
        algos_of(tmp_path / "model.zip")
