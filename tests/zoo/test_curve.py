"""The picture of a run's evaluations in its folder."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.zoo.curve import write_curve
from sb3_sparse.zoo.folder import RunFolder


def run_in(folder, status="finished"):
    (folder / "sparsity.json").write_text(json.dumps({"format": 1, "status": status}))
    np.savez(
        folder / "evaluations.npz",
        timesteps=[100, 200, 300],
        results=[[0.0, 4.0], [10.0, 10.0], [7.0, 9.0]],
        ep_lengths=[[5, 5], [5, 5], [5, 5]],
    )
    return RunFolder(folder)


def test_the_curve_is_one_picture_in_the_folder(tmp_path):
    folder = run_in(tmp_path)
    before = {path.name for path in tmp_path.iterdir()}
    path = write_curve(folder, "sac/Pendulum-v1_1")
    assert path == tmp_path / "curve.png"
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert min(picture.size) > 300
    assert {one.name for one in tmp_path.iterdir()} - before == {"curve.png"}


def test_a_run_without_evaluations_has_no_curve(tmp_path):
    assert write_curve(RunFolder(tmp_path), "none") is None
    assert not list(tmp_path.iterdir())


def test_damaged_evaluations_and_runs_that_go_on_are_named(tmp_path):
    folder = run_in(tmp_path)
    folder.evaluations.write_bytes(b"PK\x03\x04 half")
    with pytest.raises(CorruptStateError, match="damaged"):
        write_curve(folder, "half")
    with pytest.raises(ConfigError, match="is not over"):
        write_curve(run_in(tmp_path, "running"), "early")
