"""Launchers run every task in a process of its own, and survive what happens to those."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import closing

import pytest

from sb3_sparse.errors import ConfigError, MissingExtra
from sb3_sparse.launch import Task, launcher_named, launcher_names

NAMES = launcher_names()


def ended(launcher, tasks, workers=2):
    return [end for end in launcher.run(tasks, workers) if end is not None]


@pytest.fixture(scope="module", params=NAMES)
def launcher(request):
    return launcher_named(request.param)


def test_tasks_run_with_one_thread_each_and_return_what_they_made(launcher):
    tasks = [
        Task("root", "math:sqrt", {}),  # takes no keyword: fails
        Task("threads", "torch:get_num_threads", {}),
        Task("process", "os:getpid", {}),
        Task("other process", "os:getpid", {}),
    ]
    ends = {end.task.name: end for end in ended(launcher, tasks)}
    assert ends.keys() == {task.name for task in tasks}
    assert "TypeError" in ends["root"].error
    assert ends["root"].value is None
    assert ends["threads"].value == 1
    assert all(end.error is None for name, end in ends.items() if name != "root")
    processes = {ends["process"].value, ends["other process"].value, os.getpid()}
    assert len(processes) == 3


def test_tasks_find_modules_where_this_process_finds_them(launcher, tmp_path, monkeypatch):
    (tmp_path / "only_here.py").write_text("def answer():\n    return 42\n")
    monkeypatch.syspath_prepend(tmp_path)
    (end,) = ended(launcher, [Task("here", "only_here:answer", {})])
    assert (end.value, end.error) == (42, None)


def test_a_killed_process_takes_no_other_task_with_it(launcher):
    tasks = [
        Task("killed", "os:abort", {}),
        Task("left", "subprocess:getoutput", {"cmd": "echo here"}),
    ]
    ends = {end.task.name: end for end in ended(launcher, tasks, workers=1)}
    assert ends["killed"].error
    assert ends["left"].value == "here"


def test_no_more_than_so_many_at_a_time():
    tasks = [Task(str(n), "time:sleep", {}) for n in range(3)]  # each fails, at once
    began = [end.task.name for end in ended(launcher_named("local"), tasks, workers=1)]
    assert began == ["0", "1", "2"]


def test_output_goes_to_the_log_and_a_crash_shows_its_last_lines(tmp_path):
    log = tmp_path / "logs" / "task.log"
    (end,) = ended(
        launcher_named("local"), [Task("exit", "os:_exit", {"status": 3}, log)], workers=1
    )
    assert "exited with 3" in end.error
    assert log.is_file()
    code = "import sys; print('first'); print('last', file=sys.stderr)"
    arguments = {"args": [sys.executable, "-c", code]}
    (end,) = ended(
        launcher_named("local"), [Task("talks", "subprocess:call", arguments, log)], workers=1
    )
    assert end.value == 0
    assert set(log.read_text().split()) == {"first", "last"}


def test_closing_stops_what_runs_and_starts_no_more(tmp_path):
    started = tmp_path / "started"
    arguments = {"args": ["sh", "-c", f"echo x >> {started}; exec sleep 60"]}
    tasks = [Task(str(n), "subprocess:call", arguments) for n in range(3)]
    began = time.monotonic()
    with closing(launcher_named("local").run(tasks, 1)) as endings:
        while not started.exists():
            assert next(endings) is None
    assert time.monotonic() - began < 50
    assert started.read_text() == "x\n"


def test_a_task_stops_when_the_process_that_started_it_is_gone(tmp_path):
    noted = tmp_path / "pid"
    code = (
        "from sb3_sparse.launch import Task, launcher_named\n"
        f"task = Task('t', 'subprocess:call', "
        f"{{'args': ['sh', '-c', 'echo $PPID > {noted}; exec sleep 120']}})\n"
        "list(launcher_named('local').run([task], 1))"
    )
    parent = subprocess.Popen([sys.executable, "-c", code])
    while not (noted.exists() and noted.read_text().strip()):
        time.sleep(0.1)
        assert parent.poll() is None
    child = int(noted.read_text())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    for _ in range(300):
        if not alive(child):
            break
        time.sleep(0.1)
    assert not alive(child)


def alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: launcher_named("slurm"), "unknown launcher 'slurm'; allowed are local, ray"),
        (lambda: launcher_named("local", "auto"), "'auto'.*is Ray's; add --launcher ray"),
        (lambda: list(launcher_named("local").run([], 0)), "workers must be 1 or more, got 0"),
        (lambda: list(launcher_named("ray").run([], 0)), "workers must be 1 or more, got 0"),
        (
            lambda: list(launcher_named("ray", "127.0.0.1:1").run([Task("t", "os:getpid", {})], 1)),
            "there is no Ray cluster at '127.0.0.1:1'.*ray start --head",
        ),
    ],
)
def test_mistakes(call, message):
    with pytest.raises(ConfigError, match=message):
        call()


def test_ray_that_is_missing_names_its_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtra, match=r"sb3-sparse\[ray\]"):
        launcher_named("ray")
