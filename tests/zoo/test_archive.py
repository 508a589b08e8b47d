"""The archive of runs: a file that processes append lines to, and that is read with care."""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from sb3_sparse.errors import ConfigError, CorruptStateError, SparsityWarning, Unwritable
from sb3_sparse.zoo import archive as module
from sb3_sparse.zoo.archive import Archive, Archived
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import Record


def run(address="a" * 12, status="finished", **record):
    returns = np.array([[1.0, 2.5], [-3.123456, 500.0]])
    return Archived(
        address,
        Record({"status": status, "run": {"seed": 0}, **record}),
        np.array([100.0, 200.0]),
        returns,
        np.array([[1.0, 2.0], [3.0, 500.0]]),
        {"robustness.csv": "sigma,return\n0.0,1.5\n"},
    )


def test_what_is_added_is_read_again_to_the_last_digit(tmp_path):
    archive = Archive(tmp_path / "below" / "runs.jsonl")
    archive.add([run(), run("b" * 12, "diverged")])
    lines = archive.read()
    assert list(lines) == ["a" * 12, "b" * 12]
    (found,) = lines["a" * 12]
    assert found.returns.tolist() == run().returns.tolist()
    assert found.lengths.tolist() == run().lengths.tolist()
    assert found.timesteps.tolist() == [100.0, 200.0]
    assert (found.record, found.measured) == (run().record, run().measured)


def test_a_line_is_short_and_plain_json(tmp_path):
    archive = Archive(tmp_path / "runs.jsonl")
    archive.add([run(), Archived("b" * 12, Record({"status": "counted"}))])
    first, second = archive.path.read_text().splitlines()
    assert first == (
        '{"address":"aaaaaaaaaaaa","record":{"status":"finished","run":{"seed":0}},'
        '"evaluations":{"timesteps":[100,200],"returns":[[1,2.5],[-3.123456,500]],'
        '"lengths":[[1,2],[3,500]]},"measured":{"robustness.csv":"sigma,return\\n0.0,1.5\\n"}}'
    )
    assert json.loads(second)["evaluations"] is None


def test_a_run_folder_becomes_a_line(tmp_path):
    record = {"status": "finished", "num_timesteps": 7}
    (tmp_path / "sparsity.json").write_text(json.dumps(record))
    np.savez(tmp_path / "evaluations.npz", timesteps=[7], results=[[1.5]], ep_lengths=[[9]])
    (tmp_path / "snr.csv").write_text("a,b\n")
    (tmp_path / "0.monitor.csv").write_text("of no interest")
    found = Archived.of_folder(RunFolder(tmp_path), "c" * 12, ["snr.csv", "plasticity.csv"])
    assert (found.record, found.measured) == (record, {"snr.csv": "a,b\n"})
    assert [x.tolist() for x in (found.timesteps, found.returns, found.lengths)] == (
        [[7.0], [[1.5]], [[9.0]]]
    )
    (tmp_path / "evaluations.npz").unlink()
    with pytest.raises(ConfigError, match=r"there is no file .*evaluations.npz"):
        Archived.of_folder(RunFolder(tmp_path), "c" * 12, [])
    (tmp_path / "sparsity.json").write_text('{"status": "running"}')
    with pytest.raises(ConfigError, match="is not over: its status is running"):
        Archived.of_folder(RunFolder(tmp_path), "c" * 12, [])


def test_a_run_is_added_once_and_again_only_with_more_measured(tmp_path):
    archive = Archive(tmp_path / "runs.jsonl")
    more = run(measured={"noise": {"sigmas": [0]}})
    for one in (run(), run(), more, more, run()):
        archive.add([one])
    assert [line.record.get("measured") for line in archive.read()["a" * 12]] == [
        None,
        {"noise": {"sigmas": [0]}},
    ]


def test_nothing_new_leaves_the_file_alone(tmp_path):
    archive = Archive(tmp_path / "runs.jsonl")
    archive.add([run()])
    os.utime(archive.path, (0, 0))
    archive.add([run()])
    assert archive.path.stat().st_mtime == 0


def _append(path, first):
    for number in range(first, first + 25):
        Archive(path).add([run(f"{number:012x}", text="x" * 9000)])


def test_processes_that_append_at_once_lose_nothing(tmp_path):
    path = tmp_path / "runs.jsonl"
    with ProcessPoolExecutor(3, get_context("fork")) as pool:
        list(pool.map(_append, [path] * 3, [0, 25, 40]))  # ten of them twice
    lines = Archive(path).read()
    assert sorted(lines) == [f"{number:012x}" for number in range(65)]
    assert len(path.read_bytes().splitlines()) == 65


@pytest.mark.parametrize("kept", [1, 5, 30, 200, -1])
def test_a_last_line_that_was_cut_off_is_left_out_and_then_mended(tmp_path, kept):
    archive = Archive(tmp_path / "runs.jsonl")
    archive.add([run()])
    whole = archive.path.read_bytes()
    line = run("b" * 12).line()
    archive.path.write_bytes(whole + line[: kept - 1 if kept < 0 else kept])
    with pytest.warns(SparsityWarning, match="last line of .*runs.jsonl was cut off"):
        assert list(archive.read()) == ["a" * 12]
    archive.add([])
    assert archive.path.read_bytes() == whole
    archive.add([run("b" * 12)])
    assert archive.path.read_bytes() == whole + line


def test_a_last_line_that_lacks_its_end_alone_is_kept(tmp_path):
    archive = Archive(tmp_path / "runs.jsonl")
    archive.path.write_bytes(run().line()[:-1])
    assert list(archive.read()) == ["a" * 12]
    archive.add([run("b" * 12)])
    assert archive.path.read_bytes() == run().line() + run("b" * 12).line()


def spoilt(**changed):
    return json.dumps({**json.loads(run().line()), **changed}).encode()


EVALUATIONS = json.loads(run().line())["evaluations"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"<<<<<<< HEAD", "JSONDecodeError"),
        (b"\xff\xfe", "UnicodeDecodeError"),
        (b"[1, 2]", "it holds a list, not a mapping"),
        (b'{"address": "x"}', "KeyError: 'record'"),
        (b"[" * 100_000, "RecursionError"),
        (spoilt(address=3), "its address is 3"),
        (spoilt(record=[]), "AttributeError"),
        (spoilt(record={"status": "running"}), "its status is 'running', and its run is not over"),
        (spoilt(record={"status": "finished", "num_timesteps": "x"}), "ValueError"),
        (spoilt(record={"status": "finished", "measured": 3}), "TypeError"),
        (spoilt(measured={"a.csv": 3}), "measured must map names"),
        (spoilt(measured=None), "AttributeError"),
        (spoilt(evaluations=None), "a finished run needs evaluations"),
        (spoilt(evaluations={**EVALUATIONS, "returns": [[1.0], [2.0, 3.0]]}), "ValueError"),
        (spoilt(evaluations={**EVALUATIONS, "returns": []}), "returns of shape"),
        (spoilt(evaluations={**EVALUATIONS, "timesteps": [1]}), "steps of shape"),
        (spoilt(evaluations={**EVALUATIONS, "lengths": [[1]]}), "lengths of shape"),
        (spoilt(evaluations={**EVALUATIONS, "timesteps": [1, None]}), "not finite"),
    ],
)
def test_a_damaged_line_is_named_by_its_number_and_nothing_is_written(tmp_path, line, said):
    archive = Archive(tmp_path / "runs.jsonl")
    content = run("b" * 12).line() + line + b"\n" + run().line()
    archive.path.write_bytes(content)
    for call in (archive.read, lambda: archive.add([run("c" * 12)])):
        with pytest.raises(CorruptStateError, match="runs.jsonl, line 2 is damaged") as caught:
            call()
        assert said in str(caught.value)
        assert "restore it from a copy, or remove the line" in str(caught.value)
    assert archive.path.read_bytes() == content


def test_what_is_no_archive_is_not_cut_off_as_a_broken_line(tmp_path):
    archive = Archive(tmp_path / "notes.txt")
    archive.path.write_text("my notes")
    with pytest.raises(CorruptStateError, match="notes.txt, line 1 is damaged"):
        archive.add([run()])
    assert archive.path.read_text() == "my notes"


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    archive = Archive(tmp_path / "runs.jsonl")
    archive.add([run()])
    before = archive.path.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(Unwritable, match="No space left on device; free space .* no run is lost"):
        archive.add([run("b" * 12)])
    assert archive.path.read_bytes() == before


def test_an_archive_that_is_not_there_is_a_mistake_to_read(tmp_path):
    with pytest.raises(ConfigError, match="there is no file .*runs.jsonl; study run --archive"):
        Archive(tmp_path / "runs.jsonl").read()
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        Archive(tmp_path).read()
