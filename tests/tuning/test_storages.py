"""Storages take each trial once, set torn writes aside, and stay as they are under a look."""

from __future__ import annotations

import json
import multiprocessing
import os
import sqlite3
import time
import warnings
from collections import Counter
from pathlib import Path

import pytest
from tuning_support import Here, choices, small_run

from sb3_sparse.errors import ConfigError
from sb3_sparse.tuning import tune
from sb3_sparse.tuning.backend import TrialState, optuna
from sb3_sparse.tuning.internals import id_of
from sb3_sparse.tuning.queue import QueueEmpty
from sb3_sparse.tuning.report import report_by_name
from sb3_sparse.tuning.samplers import TICKET
from sb3_sparse.tuning.storage import open_existing, open_storage

KINDS = ["journal", "sqlite", "postgres"]
FORK = multiprocessing.get_context("fork")  # a new process would import torch first
optuna.logging.set_verbosity(optuna.logging.WARNING)


@pytest.fixture(params=KINDS)
def storage(request, tmp_path):
    places = {"journal": tmp_path / "journal.log", "sqlite": f"sqlite:///{tmp_path}/studies.db"}
    return places.get(request.param) or request.getfixturevalue("postgres")


def planned(storage, name: str, trials: int, **options) -> optuna.Study:
    study = optuna.create_study(storage=open_storage(storage, **options), study_name=name)
    for number in range(trials):
        study.add_trial(
            optuna.create_trial(state=TrialState.WAITING, system_attrs={TICKET: number})
        )
    return study


def at_once(function, processes: int = 2) -> list:
    """What the function returns in several processes, given a barrier that they share."""
    barrier, answers = FORK.Barrier(processes, timeout=60), FORK.Queue()
    workers = [
        FORK.Process(target=lambda: answers.put(function(barrier))) for _ in range(processes)
    ]
    for worker in workers:
        worker.start()
    found = [answers.get(timeout=60) for _ in workers]
    for worker in workers:
        worker.join(timeout=60)
    return found


def opened(storage, name: str) -> optuna.Study:
    return optuna.load_study(storage=open_storage(storage, heartbeat=1), study_name=name)


def test_two_processes_behind_a_barrier_never_take_the_same_trial(storage):
    planned(storage, "taken", 60)

    def take(barrier):
        study, taken = opened(storage, "taken"), []
        warnings.simplefilter("ignore")  # ask() gives no signs of life
        for _ in range(30):
            barrier.wait()
            taken.append(study.ask().number)
        return taken

    first, second = at_once(take)
    assert sorted([*first, *second]) == list(range(60))
    with pytest.raises(QueueEmpty):
        opened(storage, "taken").ask()


def test_two_processes_that_find_the_same_trial_lost_put_it_into_the_queue_once(storage):
    study = planned(storage, "lost", 10, heartbeat=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(10):
            study.ask()

    def give_up(barrier):
        study = opened(storage, "lost")
        for trial in study.get_trials():
            stale = [id_of(trial)]
            study._storage._get_stale_trial_ids = lambda study_id, stale=stale: stale
            barrier.wait()
            optuna.storages.fail_stale_trials(study)

    at_once(give_up)
    states = Counter(trial.state for trial in study.get_trials())
    assert states == {TrialState.FAIL: 10, TrialState.WAITING: 10}
    assert [trial.number for trial in study.get_trials()] == list(range(20))


@pytest.mark.parametrize("kind", ["sqlite", "postgres"])
def test_a_trial_whose_worker_died_right_after_taking_it_is_found_lost(kind, tmp_path, request):
    places = {"sqlite": f"sqlite:///{tmp_path}/studies.db"}
    storage = places.get(kind) or request.getfixturevalue("postgres")
    study = planned(storage, "early death", 1, heartbeat=1)
    with pytest.warns(UserWarning, match="Heartbeat"):
        study.ask()
    time.sleep(4.5)  # three signs of life are due; databases count whole seconds
    optuna.storages.fail_stale_trials(study)
    assert [t.state for t in study.get_trials()] == [TrialState.FAIL, TrialState.WAITING]


def test_a_sign_of_life_that_the_database_refuses_ends_no_trial(tmp_path, monkeypatch):
    storage = open_storage(f"sqlite:///{tmp_path}/studies.db", heartbeat=1)

    def away(*_):
        raise optuna.exceptions.StorageInternalError("away")

    monkeypatch.setattr(storage._backend, "record_heartbeat", away)
    storage.record_heartbeat(1)


def test_sqlite_trains_a_study_to_its_end(tmp_path):
    url = f"sqlite:///{tmp_path}/studies.db"
    space = choices(weight_decay=[0.0])
    run = small_run(n_timesteps=200)
    tuned = tune(run, space, storage=url, log_folder=tmp_path, heartbeat=1)
    assert tuned.status.finished
    with sqlite3.connect(tmp_path / "studies.db") as database:
        assert database.execute("select count(*) from trials").fetchone() == (1,)


def test_a_torn_last_line_of_a_journal_is_set_aside_and_costs_nothing_else(tmp_path):
    path = tmp_path / "journal.log"
    planned(path, "study", 3)
    whole = path.read_bytes()
    torn = whole.splitlines()[-1][:40]
    path.write_bytes(whole + torn)
    with pytest.warns(UserWarning, match=r"its 40 bytes are in .*journal\.log\.torn now"):
        study = opened(path, "study")
    assert path.read_bytes() == whole
    assert (tmp_path / "journal.log.torn").read_bytes() == torn + b"\n"
    study.add_trial(optuna.create_trial(state=TrialState.WAITING))
    assert len(opened(path, "study").get_trials()) == 4


@pytest.mark.parametrize("tail", [b"\0" * 100, b"\0\0\n", b'{"op_code":4,"worker\n', b"{"])
def test_whatever_a_power_cut_leaves_in_the_last_line_is_set_aside(tail, tmp_path):
    path = tmp_path / "journal.log"
    planned(path, "study", 1)
    whole = path.read_bytes()
    path.write_bytes(whole + tail)
    with pytest.warns(UserWarning, match="was not written to its end"):
        assert len(opened(path, "study").get_trials()) == 1
    assert path.read_bytes() == whole


def test_a_journal_that_tears_while_others_work_stays_readable(tmp_path):
    path = tmp_path / "journal.log"
    study = planned(path, "study", 2)
    with path.open("ab") as file:
        file.write(b'{"op_code":4,"wor')  # another machine's, whose power went
    with pytest.warns(UserWarning, match="was not written to its end"):
        study.add_trial(optuna.create_trial(state=TrialState.WAITING))
    assert len(opened(path, "study").get_trials()) == 3
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_a_disk_that_is_full_leaves_no_half_record(tmp_path, monkeypatch):
    path = tmp_path / "journal.log"
    study = planned(path, "study", 1)
    whole = path.read_bytes()
    with monkeypatch.context() as patch:

        def full(descriptor):
            raise OSError(28, "No space left on device")

        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            study.set_user_attr("text", "long")
    assert path.read_bytes() == whole
    study.set_user_attr("text", "long")
    assert opened(path, "study").user_attrs == {"text": "long"}


@pytest.mark.parametrize("content", ["not json\nat all\n", "a diary of one line", '{"a": 1}\n'])
def test_a_file_that_is_no_journal_is_named_and_left_alone(content, tmp_path):
    path = tmp_path / "journal.log"
    path.write_text(content)
    for look in (open_storage, open_existing):
        with pytest.raises(ConfigError, match=f"the journal {path} cannot be used: its line 1 is"):
            look(path)
    assert path.read_text() == content
    assert [found.name for found in tmp_path.iterdir()] == ["journal.log"]


def test_a_journal_that_is_damaged_in_its_middle_is_refused_with_the_line(tmp_path):
    path = tmp_path / "journal.log"
    planned(path, "study", 2)
    lines = path.read_bytes().splitlines(keepends=True)
    damaged = b"".join([lines[0], b"torn\n", *lines[1:]])
    path.write_bytes(damaged)
    with pytest.raises(ConfigError, match="its line 2 is not a record of Optuna"):
        open_storage(path)
    assert path.read_bytes() == damaged


def everything_in(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_looking_at_a_study_writes_nothing_but_the_report(tmp_path):
    url = f"sqlite:///{tmp_path}/kept/studies.db"
    (tmp_path / "kept").mkdir()
    for storage in (None, url):
        tune(
            small_run(n_timesteps=200),
            choices(weight_decay=[0.0]),
            name="study",
            storage=storage,
            launcher=Here(),
            log_folder=tmp_path / "kept",
        )
    journal = tmp_path / "kept" / "tune" / "journal.log"
    journal.write_bytes(journal.read_bytes() + b'{"op_code":4,"torn')
    (journal.parent / "journal.log.alive").rmdir()
    before = everything_in(tmp_path / "kept")
    for storage in (None, url):
        report_by_name(["study"], storage, tmp_path / "kept", tmp_path / "report.html")
    assert everything_in(tmp_path / "kept") == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept", "report.csv", "report.html"]


def test_looking_at_a_database_without_studies_makes_no_tables(tmp_path):
    with sqlite3.connect(tmp_path / "other.db") as database:
        database.execute("create table mine (x)")
    before = (tmp_path / "other.db").read_bytes()
    with pytest.raises(ConfigError, match="there are no searches in sqlite:///"):
        open_existing(f"sqlite:///{tmp_path}/other.db")
    assert (tmp_path / "other.db").read_bytes() == before
