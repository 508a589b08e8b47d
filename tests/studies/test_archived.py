"""Studies whose cells go into an archive, and are taken from there."""

from __future__ import annotations

import json
import shutil

import pytest
from study_support import RUNS, Here, finish, study

from sb3_sparse.cli.study import report, status
from sb3_sparse.errors import CorruptStateError, SparsityWarning
from sb3_sparse.studies import run_study, status_of
from sb3_sparse.zoo.archive import Archive
from sb3_sparse.zoo.folder import RunFolder

NOISE = {"noise": {"sigmas": [0, 2], "n_episodes": 3}}
DIVERGES = {"method": "static", "sparsity": 0.5, "hyperparams": {"learning_rate": 1e35}}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A study of three runs that are over, one of them diverged; with its archive."""
    folder = tmp_path_factory.mktemp("trained")
    made = study(folder, runs=[*RUNS, DIVERGES], measures=NOISE)
    last = finish(made, folder / "store", archive=folder / "runs.jsonl")
    assert (last.done, last.diverged, last.failed) == (2, 1, {})
    return folder, made


def test_each_cell_that_is_over_is_a_line_with_all_that_came_out(trained):
    folder, made = trained
    lines = Archive(folder / "runs.jsonl").read()
    assert list(lines) == [cell.address for cell in made.cells]
    for cell in made.cells:
        (line,) = lines[cell.address]
        where = cell.folder(folder / "store").path
        assert line.record == RunFolder(where).record()
        if line.record["status"] == "finished":
            assert line.timesteps.tolist() == [100.0, 200.0, 300.0]
            assert line.returns.shape == line.lengths.shape == (3, 1)
            assert line.measured == {"robustness.csv": (where / "robustness.csv").read_text()}
        else:
            assert line.record["status"] == "diverged"
            assert str(folder) not in json.dumps(dict(line.record))  # of whom would it tell?


def test_what_is_in_the_archive_is_not_run_again_without_its_folder(trained, tmp_path):
    folder, made = trained
    launcher = Here()
    last = finish(made, tmp_path / "empty", launcher, folder / "runs.jsonl")
    assert (last.done, last.diverged, last.open, launcher.called) == (2, 1, 0, [])
    assert not (tmp_path / "empty").exists()


def test_what_lies_done_in_folders_is_archived_before_anything_is_run(trained, tmp_path):
    folder, made = trained
    path = tmp_path / "runs.jsonl"
    progress = run_study(made, folder / "store", Here(), 1, path)
    next(progress)
    assert path.read_bytes() == (folder / "runs.jsonl").read_bytes()
    content = path.read_bytes()
    path.write_bytes(content[:-40])  # killed while it wrote the last line
    with pytest.warns(SparsityWarning, match="was cut off"):
        finish(made, folder / "store", archive=path)
    assert path.read_bytes() == content


def test_a_folder_that_cannot_be_archived_is_named_and_hides_no_other(trained, tmp_path):
    folder, made = trained
    shutil.copytree(folder / "store", tmp_path / "store")
    (made.cells[0].folder(tmp_path / "store").path / "evaluations.npz").unlink()
    with pytest.warns(SparsityWarning, match="does not go into the archive: .*evaluations.npz"):
        finish(made, tmp_path / "store", archive=tmp_path / "runs.jsonl")
    assert len(Archive(tmp_path / "runs.jsonl").read()) == 2


def test_a_damaged_archive_is_refused_before_anything_is_run(trained, tmp_path):
    _, made = trained
    (tmp_path / "runs.jsonl").write_text("{}\n")
    launcher = Here()
    with pytest.raises(CorruptStateError, match="line 1 is damaged"):
        finish(made, tmp_path / "store", launcher, tmp_path / "runs.jsonl")
    assert launcher.called == []


def test_a_report_of_the_archive_is_that_of_the_folders(trained, tmp_path):
    folder, _ = trained
    mine, store = str(folder / "mine.yml"), folder / "store"
    pages = [
        ("folders", store, None),
        ("both", store, folder / "runs.jsonl"),
        ("archive", store, folder / "runs.jsonl"),
    ]
    for name, _, archive in pages:
        if name == "archive":
            shutil.move(store, tmp_path / "elsewhere")
        report(mine, "smoke", store, archive, tmp_path / name)
    shutil.move(tmp_path / "elsewhere", store)
    for path in sorted((tmp_path / "folders").rglob("*.*")):
        content = path.read_bytes()
        for name in ("both", "archive"):
            other = tmp_path / name / path.relative_to(tmp_path / "folders")
            said = other.read_bytes().replace(f" --archive {folder}/runs.jsonl".encode(), b"")
            assert said == content, path.name
    page = (tmp_path / "archive/index.html").read_text()
    assert "2 finished runs, 600 environment steps; 1 diverged." in page
    assert "still to be trained" not in page


def test_the_status_counts_what_is_in_the_archive(trained, tmp_path, capsys):
    folder, _ = trained
    status(str(folder / "mine.yml"), "smoke", tmp_path / "empty", folder / "runs.jsonl")
    assert "2 done, 1 diverged, 0 running, 0 stopped" in capsys.readouterr().out


def test_a_cell_of_which_more_is_to_be_measured_is_not_done(trained, tmp_path):
    """By the trained model where it still is, else by training it again."""
    folder, _ = trained
    archive = tmp_path / "runs.jsonl"
    shutil.copytree(folder / "store", tmp_path / "store")
    shutil.copy(folder / "runs.jsonl", archive)
    more = {"noise": {"sigmas": [1], "n_episodes": 2}}
    noisy = study(tmp_path, runs=RUNS[1:], measures=more)
    (cell,) = noisy.cells
    zip_of = cell.folder(tmp_path / "store").path / "CartPole-v1.zip"
    before = zip_of.stat().st_mtime_ns
    assert status_of(cell, tmp_path / "store", Archive(archive).read()).state == "stopped"
    assert finish(noisy, tmp_path / "store", archive=archive).done == 1
    assert zip_of.stat().st_mtime_ns == before
    first, second = Archive(archive).read()[cell.address]
    assert [line.record["measured"] for line in (first, second)] == [NOISE, more]
    assert status_of(cell, tmp_path / "none", Archive(archive).read()).archived.record == (
        second.record
    )
    shutil.rmtree(tmp_path / "store")
    less = study(tmp_path, runs=RUNS[1:], measures={"noise": {"sigmas": [3], "n_episodes": 1}})
    assert status_of(cell, tmp_path / "store", Archive(archive).read()).state == "done"
    launcher = Here()
    assert finish(less, tmp_path / "store", launcher, archive).done == 1
    assert launcher.called == [cell.name]
    *_, third = Archive(archive).read()[cell.address]
    assert third.returns.tolist() == first.returns.tolist()
