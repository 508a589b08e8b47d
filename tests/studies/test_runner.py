"""Studies run to their end, also after what goes wrong."""

from __future__ import annotations

import csv
import importlib
import io
import json
import shutil
import zipfile

import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv
from study_support import QUICK, RUNS, Here, finish, study

from sb3_sparse.studies import run_study, status_of
from sb3_sparse.studies.noise import noisy_envs
from sb3_sparse.studies.status import CellState, CellStatus, counts
from sb3_sparse.studies.worker import work_on
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.saved import SavedModel


def weights(folder):
    with zipfile.ZipFile(folder / "CartPole-v1.zip") as file:
        return th.load(io.BytesIO(file.read("policy.pth")), weights_only=True)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A study of two runs that are done."""
    folder = tmp_path_factory.mktemp("trained")
    made = study(folder)
    last = finish(made, folder / "store")
    assert (last.done, last.planned, last.failed) == (2, 2, {})
    return made, folder / "store"


def test_runs_lie_in_folders_that_their_content_names(trained):
    made, store = trained
    for cell in made.cells:
        folder = store / "runs" / "dqn" / f"CartPole-v1_{cell.address}"
        assert RunFolder(folder).record()["status"] == "finished"
        assert (folder / "evaluations.npz").is_file()
        assert status_of(cell, store).state == "done"


def test_a_cell_that_is_done_is_never_run_again_nor_by_another_study(trained, tmp_path):
    _, store = trained
    other = study(tmp_path, "other", runs=[*RUNS, {"method": "static", "sparsity": 0.75}])
    copy = tmp_path / "store"
    shutil.copytree(store, copy)
    launcher = Here()
    last = finish(other, copy, launcher)
    assert len(launcher.called) == 1
    assert "75%" in launcher.called[0]
    assert last.done == 3


def test_an_interrupted_cell_goes_on_and_a_lost_folder_begins_anew(trained, tmp_path):
    made, store = trained
    copy = tmp_path / "store"
    shutil.copytree(store, copy)
    first, second = (cell.folder(copy).path for cell in made.cells)
    record = json.loads((first / "sparsity.json").read_text())
    record.update(status="evaluating", trained=True)
    (first / "sparsity.json").write_text(json.dumps(record))
    before = weights(first)
    (second / "sparsity.json").unlink()  # a process that was killed at its very start
    assert [status_of(c, copy).state for c in made.cells] == ["stopped", "waiting"]
    assert finish(made, copy).done == 2
    assert all(th.equal(value, before[name]) for name, value in weights(first).items())
    assert RunFolder(second).record()["status"] == "finished"


def test_a_failed_cell_is_tried_once_more_after_the_others(tmp_path):
    made = study(tmp_path, trained=False)
    names = [cell.name for cell in made.cells]
    launcher = Here({names[0]: 1})
    last = finish(made, tmp_path / "store", launcher)
    assert launcher.called == [names[0], names[1], names[0]]
    assert (last.done, last.failed, last.retried) == (2, {}, [names[0]])
    assert not made.cells[0].errors(tmp_path / "store").exists()


class Backwards(Here):
    """Runs the tasks in their order, and tells their ends as slow first ones come out."""

    def run(self, tasks, workers):
        yield from reversed(list(super().run(tasks, workers)))


def test_cells_are_run_seed_by_seed_also_when_they_are_tried_again(tmp_path):
    scales = {"smoke": {**QUICK, "seeds": 2, "env_id": ["CartPole-v1", "Acrobot-v1"]}}
    made = study(tmp_path, trained=False, scales=scales)
    names = [cell.name for cell in made.cells]
    assert [name.endswith("seed 1") for name in names] == [False] * 4 + [True] * 4
    launcher = Backwards(dict.fromkeys([names[1], names[2], names[5]], 1))
    assert finish(made, tmp_path / "store", launcher).done == 8
    assert launcher.called == [*names, names[1], names[2], names[5]]


def test_a_cell_that_fails_twice_is_reported_with_its_traceback_and_the_others_go_on(tmp_path):
    made = study(tmp_path, trained=False)
    names = [cell.name for cell in made.cells]
    store = tmp_path / "store"
    last = finish(made, store, Here({names[0]: 2}))
    assert last.failed == {names[0]: "Traceback: it broke"}
    assert last.done == 1
    assert status_of(made.cells[0], store).state == "failed"
    assert made.cells[0].errors(store).read_text().count("Traceback: it broke") == 2
    again = finish(made, store)  # the next start tries it anew
    assert (again.done, again.failed) == (2, {})


def test_a_cell_that_diverges_is_over_is_no_failure_and_is_not_tried_again(tmp_path):
    rates = {"learning_rate": [1e35, 1e-3]}
    made = study(tmp_path, runs=[{"method": "static", "sparsity": 0.5, "vary": rates}])
    store, launcher = tmp_path / "store", Here()
    last = finish(made, store, launcher)
    assert (last.done, last.diverged, last.failed, last.open) == (1, 1, {}, 0)
    assert len(launcher.called) == 2
    again = finish(made, store, launcher)
    assert (again.done, again.diverged, again.open) == (1, 1, 0)
    assert len(launcher.called) == 2
    statuses = [status_of(cell, store) for cell in made.cells]
    assert sorted(one.state for one in statuses) == ["diverged", "done"]
    assert counts(statuses)["diverged"] == 1


def test_a_cell_that_another_process_trains_is_left_to_it(tmp_path):
    made = study(tmp_path)
    store = tmp_path / "store"
    folder = made.cells[0].folder(store).path
    folder.mkdir(parents=True)
    RunFolder(folder).write(status="running", num_timesteps=7)
    with RunFolder(folder).locked():
        assert status_of(made.cells[0], store).state == "running"
        assert work_on(made.cells[0], store) == "running"
    assert RunFolder(folder).record()["num_timesteps"] == 7


def test_a_cell_that_another_process_has_just_begun_is_left_to_it(tmp_path):

    made = study(tmp_path)
    store = tmp_path / "store"
    folder = made.cells[0].folder(store).path
    folder.mkdir(parents=True)
    (folder / "0.monitor.csv").write_text("of the other process")
    with RunFolder(folder).locked():  # which has written no record yet
        assert status_of(made.cells[0], store).state == "running"
        assert work_on(made.cells[0], store) == "running"
    assert (folder / "0.monitor.csv").read_text() == "of the other process"


def test_a_cell_that_another_process_takes_or_ends_after_one_has_looked_is_not_run_again(
    trained, tmp_path, monkeypatch
):
    made, store = trained
    copy = tmp_path / "store"
    shutil.copytree(store, copy)
    (cell, _), (folder, _) = made.cells, [cell.folder(copy).path for cell in made.cells]
    before = weights(folder)
    work = importlib.import_module(work_on.__module__)
    waiting = CellStatus(cell, RunFolder(folder), CellState.WAITING)
    looks = iter([True])  # it looked as if there were nothing
    monkeypatch.setattr(work, "status_of", lambda *_: waiting)
    really = work._is_trained
    monkeypatch.setattr(work, "_is_trained", lambda f: not next(looks, False) and really(f))
    assert work_on(cell, copy) == "done"
    assert all(th.equal(value, before[name]) for name, value in weights(folder).items())
    with RunFolder(folder).locked():
        assert work_on(cell, copy) == "running"


def test_counted_cells_have_sizes_and_no_model(tmp_path):
    uniform = {"method": "static", "sparsity": 0.5, "distribution": "uniform"}
    made = study(tmp_path, trained=False, runs=[RUNS[0], uniform])
    finish(made, tmp_path / "store")
    sparse = made.cells[1].folder(tmp_path / "store").record()
    assert sparse["status"] == "counted"
    # 4-8-2: 32 + 16 weights, half of them active, and ten biases
    assert sparse["total"]["nnz"] == 24
    assert sparse["total"]["parameters"] == 34
    assert not list(made.cells[1].folder(tmp_path / "store").path.glob("*.zip"))


def test_a_pruned_network_is_counted_as_it_ends(tmp_path):
    pruned = {"method": "prune", "sparsity": 0.5, "distribution": "uniform"}
    made = study(tmp_path, trained=False, runs=[pruned])
    finish(made, tmp_path / "store")
    record = made.cells[0].folder(tmp_path / "store").record()
    assert record["total"]["nnz"] == record["total"]["wanted_nnz"] == 24  # of 48
    assert record["settings"]["policy_kwargs"]["initial_sparsity"] == 0.0


def test_noise_is_measured_of_the_trained_model_without_training_it_again(trained, tmp_path):
    _, store = trained
    copy = tmp_path / "store"
    shutil.copytree(store, copy)
    noisy = study(tmp_path, measures={"noise": {"sigmas": [0, 2], "n_episodes": 3}})
    folder = noisy.cells[1].folder(copy).path
    before = (folder / "CartPole-v1.zip").stat().st_mtime_ns
    assert status_of(noisy.cells[1], copy).state == "stopped"
    finish(noisy, copy)
    assert (folder / "CartPole-v1.zip").stat().st_mtime_ns == before
    with (folder / "robustness.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["sigma"]) for row in rows] == [0.0] * 3 + [2.0] * 3
    assert all(1 <= float(row["return"]) <= 500 for row in rows)
    assert status_of(noisy.cells[1], copy).state == "done"


def test_ten_noisy_environments_are_of_one_process(trained):
    made, store = trained
    saved = SavedModel.find(made.cells[0].folder(store).path)
    with_noise = noisy_envs(saved, saved.load())
    envs = with_noise(1.0)
    assert isinstance(envs.unwrapped, DummyVecEnv)
    assert envs.num_envs == 10


def test_what_is_measured_during_training_lies_beside_the_evaluations(tmp_path):
    measures = {"snr": {"every": 100}, "plasticity": {"every": 100}}
    made = study(tmp_path, runs=RUNS[1:], measures=measures)
    finish(made, tmp_path / "store")
    folder = made.cells[0].folder(tmp_path / "store").path
    for name in ("snr", "plasticity"):
        with (folder / f"{name}.csv").open() as file:
            steps = {int(float(row["timesteps"])) for row in csv.DictReader(file)}
        assert max(steps) == 300


def test_time_left_is_of_the_cells_still_to_come(tmp_path):
    made = study(tmp_path, trained=False)
    seen = [
        (p.done, p.open, p.seconds_left is None)
        for p in run_study(made, tmp_path / "store", Here(), 1)
    ]
    assert seen == [(0, 2, True), (1, 1, False), (2, 0, False)]
