"""The picture of a run's evaluations in its folder."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from sb3_sparse.errors import ConfigError, CorruptStateError
from sb3_sparse.zoo.curve import curve, what_was_trained, write_curve
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.spec import RunSpec


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


def test_the_curve_says_what_was_trained_and_counts_steps_in_thousands():
    spec = RunSpec(algo="sac", env_id="Pendulum-v1", method="rigl", sparsity=0.999)
    title = what_was_trained(spec, "rigl", 0.9990012)
    assert title == "SAC on Pendulum-v1, RigL at 99.9% sparsity"
    assert what_was_trained(spec, "dense", 0.0) == "SAC on Pendulum-v1, dense"
    figure = curve(title, np.array([5_000, 10_000, 20_000]), np.zeros((3, 20))).figure
    figure.draw_without_rendering()
    (axes,) = figure.axes
    ticks = [text.get_text() for text in axes.get_xticklabels()]
    assert [tick for tick in ticks if tick in ("5k", "10k", "15k", "20k")] == [
        "5k", "10k", "15k", "20k",
    ]  # fmt: skip
    assert axes.xaxis.get_offset_text().get_text() == ""
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "standard deviation of 20 episodes"
    ]


def test_a_long_title_is_broken_instead_of_cut_off():
    spec = RunSpec(algo="dqn", env_id="MontezumaRevengeNoFrameskip-v4", method="granet")
    title = what_was_trained(spec, "granet", 0.9)
    figure = curve(title, np.array([1, 2]), np.zeros((2, 2))).figure
    figure.draw_without_rendering()
    box = figure.axes[0].title.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.canvas.get_width_height()[0]
