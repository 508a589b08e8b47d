"""Whatever happens to workers, every planned trial is completed once."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from itertools import product

import pytest
from support import run_command
from tuning_support import Here, NoWorkers, choices, small_run

from sb3_sparse.errors import ConfigError, TuningFailed
from sb3_sparse.launch import Launcher, TaskResult
from sb3_sparse.tuning import Space, tune
from sb3_sparse.tuning.backend import TrialState, optuna
from sb3_sparse.tuning.queue import QueueEmpty
from sb3_sparse.tuning.samplers import TICKET, sampler_of
from sb3_sparse.tuning.search import Search, ticket_of
from sb3_sparse.tuning.storage import open_storage, retry_with
from sb3_sparse.tuning.tuner import define
from sb3_sparse.tuning.worker import TooManyFailures, work

GRID = dict(weight_decay=[0.0, 1e-4], update_interval=[100, 200, 400])
CELLS = {tuple(cell) for cell in product(*GRID.values())}


def cell_of(trial) -> tuple[float, int]:
    return trial.params["weight_decay"], trial.params["update_interval"]


def states(study) -> Counter[str]:
    return Counter(trial.state.name for trial in study.get_trials())


@pytest.mark.parametrize("kind", ["journal", "postgres"])
def test_four_workers_two_of_them_killed_complete_every_cell_once(
    kind, tmp_path, request, monkeypatch
):
    monkeypatch.setattr("sb3_sparse.launch.local.POLL_SECONDS", 0.1)
    storage = request.getfixturevalue("postgres") if kind == "postgres" else None
    killed: dict[int, int] = {}

    def kill_two(status):
        for trial in status.running:
            worker = trial.user_attrs.get("worker")
            if worker is None or len(killed) == 2:
                continue
            pid = int(worker.rpartition(":")[2])
            if pid not in killed and trial.intermediate_values:
                os.kill(pid, signal.SIGKILL)
                killed[pid] = trial.number

    tuned = tune(
        small_run(n_timesteps=1500),
        choices(**GRID),
        storage=storage,
        log_folder=tmp_path,
        workers=4,
        heartbeat=1,
        watch=kill_two,
    )
    assert len(killed) == 2
    assert sorted(tuned.errors.values()) == ["its process was killed by SIGKILL"] * 2
    trials = tuned.study.get_trials()
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    assert Counter(map(cell_of, done)) == dict.fromkeys(CELLS, 1)
    assert states(tuned.study) == {"COMPLETE": 6, "FAIL": 2}
    lost = {trial.number: cell_of(trial) for trial in trials if trial.state == TrialState.FAIL}
    assert lost.keys() == set(killed.values())
    again = {trial.system_attrs["failed_trial"]: cell_of(trial) for trial in trials[6:]}
    assert again == lost
    folders = {path.name for path in (tuned.folder / "trials").iterdir()}
    assert folders == {str(trial.number) for trial in done}
    assert tuned.status.finished

    more = tune(small_run(n_timesteps=1500), choices(**GRID), storage=storage, log_folder=tmp_path)
    assert not more.began
    assert len(more.study.get_trials()) == 8
    assert more.best.params == tuned.best.params


def made(tmp_path, space=None, **options):
    return tune(
        small_run(),
        space or choices(**GRID),
        log_folder=tmp_path,
        launcher=NoWorkers(),
        name="study",
        **options,
    )


def test_a_study_holds_its_whole_budget_and_gives_nothing_else(tmp_path):
    study = made(tmp_path).study
    assert states(study) == {"WAITING": 6}
    journal = tmp_path / "tune" / "journal.log"
    taken = optuna.load_study(storage=open_storage(journal), study_name="study")
    taken.optimize(lambda trial: 0.0, n_trials=6)
    assert states(study) == {"COMPLETE": 6}
    with pytest.raises(Exception, match="^$"):
        taken.optimize(lambda trial: 0.0, n_trials=1)
    assert states(study) == {"COMPLETE": 6}


def test_a_trial_is_stale_after_three_missing_signs_and_waits_again(tmp_path):
    made(tmp_path)
    storage = open_storage(tmp_path / "tune" / "journal.log", heartbeat=1)
    study = optuna.load_study(storage=storage, study_name="study")
    with pytest.warns(UserWarning, match="Heartbeat"):
        trial = study.ask()
    storage.record_heartbeat(trial._trial_id)
    optuna.storages.fail_stale_trials(study)
    assert states(study) == {"RUNNING": 1, "WAITING": 5}
    sign = tmp_path / "tune" / "journal.log.alive" / str(trial._trial_id)
    os.utime(sign, (time.time() - 2.5, time.time() - 2.5))
    optuna.storages.fail_stale_trials(study)
    assert states(study) == {"RUNNING": 1, "WAITING": 5}
    os.utime(sign, (time.time() - 3.5, time.time() - 3.5))
    optuna.storages.fail_stale_trials(study)
    assert states(study) == {"FAIL": 1, "WAITING": 6}


def test_an_interrupted_study_goes_on_with_the_same_command(tmp_path, monkeypatch, capsys):
    args = ["-n", "3000", "--eval-freq", "200", "--eval-episodes", "1", "--workers", "1"]
    args += ["--space", "space.yml", "-params", "net_arch:[16]", "learning_starts:50"]
    (tmp_path / "space.yml").write_text("weight_decay: [0.0, 1.0e-4]\n")
    code = "from sb3_sparse.cli import main; main()"
    command = [sys.executable, "-c", code, "tune", *args]
    journal = tmp_path / "logs" / "tune" / "journal.log"

    running = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    name = "dqn_CartPole-v1_rigl_0.9_space"
    while True:
        assert running.poll() is None
        if journal.exists():
            seen = optuna.storages.JournalStorage(
                optuna.storages.journal.JournalFileBackend(str(journal))
            )
            names = [study.study_name for study in seen.get_all_studies()]
            if name in names:
                study = optuna.load_study(study_name=name, storage=seen)
                if any(t.intermediate_values for t in study.get_trials(deepcopy=False)):
                    break
        time.sleep(0.1)
    running.send_signal(signal.SIGINT)
    said, _ = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "Interrupted. Finished trials are kept; the same command continues." in said
    found = states(study)
    assert found["FAIL"] == 1
    assert found["RUNNING"] == 0
    assert found["WAITING"] == 2 - found["COMPLETE"]

    monkeypatch.chdir(tmp_path)
    _, said, _ = run_command(monkeypatch, capsys, "tune", *args)
    assert f"Search {name}: 2 of 2 trials are done." in said
    assert states(study)["COMPLETE"] == 2


def test_trials_that_fail_are_noted_and_tried_again_by_the_next_command(tmp_path):
    space = choices(env_wrapper=["no.such.Wrapper", "no.such.Other", None])
    made(tmp_path, space)
    journal = tmp_path / "tune" / "journal.log"
    assert work(journal, "study", tmp_path / "trials") == {"trained": 1, "failed": 2}
    study = optuna.load_study(storage=open_storage(journal), study_name="study")
    status = Search(study).status()
    assert [len(status.done), len(status.failed)] == [1, 2]
    assert not status.finished
    assert all("No module named 'no'" in trial.user_attrs["error"] for trial in status.failed)
    made(tmp_path, space)
    assert states(study) == {"COMPLETE": 1, "FAIL": 2, "WAITING": 2}


@pytest.mark.parametrize("trials", [2, 5])  # a worker gives up after three
def test_a_study_in_which_every_trial_fails_is_an_error_with_the_first_reason(trials, tmp_path):
    space = choices(env_wrapper=[f"no.such.Wrapper{n}" for n in range(trials)])
    begun = min(trials, 3)
    with pytest.raises(TuningFailed, match=rf"that was begun \({begun}\) .*'no'") as said:
        tune(small_run(), space, log_folder=tmp_path, launcher=Here(), name="study")
    assert "first trial 0: " in str(said.value)
    assert f"The logs of the workers are in {tmp_path}/tune/study;" in str(said.value)
    tune(small_run(), choices(env_wrapper=[None, "no.such"]), log_folder=tmp_path, launcher=Here())


def test_workers_that_come_to_no_trial_are_an_error_too(tmp_path):
    class Dead(Launcher):
        def run(self, tasks, workers):
            yield TaskResult(tasks[0], error="its process was killed\nby SIGKILL")

    with pytest.raises(TuningFailed, match="every worker .* failed, first worker 1: by SIGKILL"):
        tune(small_run(), choices(**GRID), log_folder=tmp_path, launcher=Dead())


@pytest.mark.parametrize("names", [("x/y", "x-y", "x%2Fy", "x%y", "x%25y"), ("a\\b", "a%5Cb")])
def test_studies_of_different_names_never_share_a_folder(names, tmp_path):
    folders = {
        tune(
            small_run(), choices(**GRID), log_folder=tmp_path, name=name, launcher=NoWorkers()
        ).folder
        for name in names
    }
    assert len(folders) == len(names)
    assert {folder.parent for folder in folders} == {tmp_path / "tune"}


def test_a_worker_that_does_not_see_the_study_says_so(tmp_path):
    with pytest.raises(ConfigError, match="there is no search 'study' in .*elsewhere.log of "):
        work(tmp_path / "elsewhere.log", "study", tmp_path / "trials")


def test_three_failures_in_a_row_end_a_worker(tmp_path):
    made(tmp_path, choices(env_wrapper=[f"no.such.Wrapper{n}" for n in range(4)]))
    with pytest.raises(TooManyFailures, match="3 trials in a row have failed, the last one with: "):
        work(tmp_path / "tune" / "journal.log", "study", tmp_path / "trials")


def test_a_study_that_was_not_filled_to_its_end_is_filled(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_sparse.tuning.lock.PATIENCE", 0.5)
    study = made(tmp_path).study
    journal = tmp_path / "tune" / "journal.log"
    lines = journal.read_text().splitlines()
    journal.write_text("\n".join(lines[:6]) + "\n")  # as a kill would have left it
    storage = open_storage(journal)
    assert states(optuna.load_study(storage=storage, study_name="study"))["WAITING"] < 6
    definition = define(small_run(), choices(**GRID), 1, None, None, tmp_path)
    study = Search.enter(storage, "study", definition, 6).study
    assert states(study) == {"WAITING": 6}
    grid_ids = {trial.system_attrs["grid_id"] for trial in study.get_trials()}
    assert grid_ids == set(range(6))


def test_more_trials_can_be_asked_for_later(tmp_path):
    assert states(made(tmp_path, trials=2).study) == {"WAITING": 2}
    assert states(made(tmp_path, trials=4).study) == {"WAITING": 4}
    assert states(made(tmp_path, trials=3).study) == {"WAITING": 4}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(seeds=2), "seeds is 1 there and 2 now"),
        (dict(pruner="median"), "pruner is 'none' there and 'median' now"),
        (dict(space=choices(weight_decay=[0.0])), r"space.distributions.update_interval is"),
    ],
)
def test_another_study_of_the_same_name_is_refused(tmp_path, change, message):
    made(tmp_path)
    with pytest.raises(ConfigError, match=f"another search 'study'.*{message}.*--study-name"):
        made(tmp_path, **change)


def test_a_study_of_somebody_else_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_sparse.tuning.lock.PATIENCE", 0.1)
    (tmp_path / "tune").mkdir()
    url = f"sqlite:///{tmp_path}/studies.db"
    study = optuna.create_study(storage=url, study_name="study")
    study.optimize(lambda trial: trial.suggest_float("x", 0, 1), n_trials=1)
    with pytest.raises(ConfigError, match="it was not made by sb3-sparse"):
        made(tmp_path, storage=url)
    assert len(study.trials) == 1


def unreachable():
    return "postgresql://tuner:s3cret@127.0.0.1:9/studies"


@pytest.mark.parametrize(
    ("storage", "message"),
    [
        (unreachable(), r"postgresql\+psycopg://tuner:\*\*\*@127.0.0.1:9/studies cannot be"),
        (f"{unreachable()}?password=s3cret", "password=hidden cannot be reached"),
        ("redis://:s3cret@localhost", "the storage redis://... is unknown, .*; allowed are"),
        ("postgres:/s3cret://x", "the storage of this form is unknown"),
    ],
)
def test_a_storage_that_cannot_be_reached_is_named_without_its_password(tmp_path, storage, message):
    with pytest.raises(ConfigError, match=message) as caught:
        tune(small_run(), choices(**GRID), storage=storage, log_folder=tmp_path)
    assert "s3cret" not in str(caught.value)
    assert caught.value.__suppress_context__ or caught.value.__context__ is None


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (
            "postgresql://u:s3cr@t3@127.0.0.1:9/x",
            "more than one @; write an @ in a password as",
        ),
        ("postgresql://u:s3?cr@t3@127.0.0.1:9/x", "more than one @; write an @ in a password as"),
        (
            "sqlite://",
            "lives in a single process, but workers are processes of their own; name a file",
        ),
        (
            "postgresql://u:p:s3cret@127.0.0.1:t3/x",
            "is unknown, or the rest of its URL is malformed",
        ),
    ],
)
def test_an_odd_password_is_not_shown_either(url, message):
    with pytest.raises(ConfigError, match=message) as caught:
        open_storage(url)
    assert not re.search("s3|t3", str(caught.value))


@pytest.mark.parametrize("kind", ["journal", "sqlite", "postgres"])
def test_commands_that_start_or_extend_a_study_at_once_plan_each_trial_once(
    kind, tmp_path, request
):
    storages = {"journal": tmp_path / "j.log", "sqlite": f"sqlite:///{tmp_path}/s.db"}
    storage = storages.get(kind) or request.getfixturevalue("postgres")
    space = choices(weight_decay=[n * 1e-6 for n in range(30)])
    definition = define(small_run(), space, 1, None, None, tmp_path)
    failures = []

    def enter(trials):
        try:
            Search.enter(open_storage(storage), "at once", definition, trials)
        except Exception as error:
            failures.append(error)

    for trials in (10, 30):
        threads = [threading.Thread(target=enter, args=(trials,)) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not failures
        study = optuna.load_study(storage=open_storage(storage), study_name="at once")
        assert sorted(map(ticket_of, study.get_trials())) == list(range(trials))
    names = {summary.study_name for summary in open_storage(storage).get_all_studies()}
    assert not {name for name in names if "being filled" in name}


def test_what_was_interrupted_comes_first_and_changes_nothing(tmp_path):
    space = Space("s", {"x": optuna.distributions.FloatDistribution(0, 1)})

    def sampled(name, interrupted):
        storage = open_storage(tmp_path / name)
        study = optuna.create_study(storage=storage, direction="maximize")
        study.sampler = sampler_of("tpe", space, 0)
        for number in range(20):
            waiting = optuna.create_trial(state=TrialState.WAITING, system_attrs={TICKET: number})
            study.add_trial(waiting)
        asked = 0

        def objective(trial):
            nonlocal asked
            asked += 1
            x = trial.suggest_float("x", 0, 1)
            if asked == interrupted:
                raise KeyboardInterrupt
            return -((x - 0.3) ** 2)

        while True:
            try:
                study.optimize(objective, n_trials=1)
            except KeyboardInterrupt:
                retry_with(None)(study, study.get_trials()[interrupted - 1])
            except QueueEmpty:
                break
        done = [trial for trial in study.get_trials() if trial.state == TrialState.COMPLETE]
        return {ticket_of(trial): trial.params for trial in done}

    assert sampled("whole", None) == sampled("interrupted", 13)


def test_a_storage_that_goes_away_is_one_line(tmp_path, monkeypatch):
    made(tmp_path)

    def gone(search):
        raise optuna.exceptions.StorageInternalError("me:s3cret@host")

    looks = iter([Search.status])
    monkeypatch.setattr(Search, "status", lambda search: next(looks, gone)(search))
    with pytest.raises(ConfigError, match="journal.log cannot be reached any more") as caught:
        made(tmp_path, watch=lambda status: None)
    assert "s3cret" not in str(caught.value)


@pytest.mark.parametrize("name", ["", ".", "..", "-x"])
def test_names_that_are_no_folders_are_refused(tmp_path, name):
    with pytest.raises(ConfigError, match="a search cannot be named"):
        tune(small_run(), choices(**GRID), log_folder=tmp_path, name=name, launcher=NoWorkers())
    assert not list(tmp_path.iterdir())


def test_a_lock_of_a_dead_process_is_taken_over_and_that_of_a_live_one_is_not(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("sb3_sparse.tuning.lock.PATIENCE", 1.0)
    storage = open_storage(tmp_path / "j.log")
    lock = optuna.create_study(storage=storage, study_name="study is being filled")
    definition = define(small_run(), choices(**GRID), 1, None, None, tmp_path)
    entered = threading.Thread(target=Search.enter, args=(storage, "study", definition, 6))
    entered.start()
    for _ in range(8):
        time.sleep(0.4)
        lock.set_user_attr("alive", time.time())
        assert entered.is_alive()
    entered.join(timeout=20)
    assert not entered.is_alive()
    assert [summary.study_name for summary in storage.get_all_studies()] == ["study"]


def test_ray_completes_every_cell_once(tmp_path):
    tuned = tune(
        small_run(n_timesteps=200),
        choices(weight_decay=[0.0, 1e-4], update_interval=[100]),
        log_folder=tmp_path,
        workers=2,
        launcher="ray",
    )
    assert tuned.errors == {}
    assert states(tuned.study) == {"COMPLETE": 2}
