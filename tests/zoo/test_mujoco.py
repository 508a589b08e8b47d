from __future__ import annotations

import gymnasium as gym
import pytest
from support import make

from sb3_sparse.zoo.environments import mujoco_warns_once
from sb3_sparse.zoo.saved import SavedModel

mujoco = pytest.importorskip("mujoco")


def test_a_warning_of_mujoco_is_printed_once_and_leaves_no_file(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_sparse.zoo.environments._said", set())
    before = mujoco.get_mju_user_warning()
    for _ in range(2):
        with mujoco_warns_once("HalfCheetah-v5"):
            gym.make("HalfCheetah-v5").close()
    out, err = capfd.readouterr()
    assert "WARNING" not in out + err
    assert len(err.strip().splitlines()) == err.count("MuJoCo warns:") <= 1
    assert list(tmp_path.iterdir()) == []
    assert mujoco.get_mju_user_warning() is before


def test_environments_of_a_saved_model_are_as_quiet(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    with mujoco_warns_once("HalfCheetah-v5"):
        make("SAC", "HalfCheetah-v5").save("model")
    SavedModel.find(tmp_path / "model.zip", env_id="HalfCheetah-v5").envs(3, 0).close()
    out, err = capfd.readouterr()
    assert "WARNING" not in out + err
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
