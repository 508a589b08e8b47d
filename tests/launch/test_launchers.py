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
from sb3_sparse.launch import LAUNCHERS, Task, launcher_named
from sb3_sparse.studies import runner
from sb3_sparse.tuning import tuner

NAMES = list(LAUNCHERS)


def ended(launcher, tasks, workers=2):
    return [end for end in launcher.run(tasks, workers) if end is not None]


LOOK = """
import os, random, numpy
print("imported")
importer = os.getpid()

def look():
    return importer, os.getppid(), os.getpid(), random.random(), numpy.random.random()
"""


@pytest.fixture(scope="module", params=NAMES)
def ends(request, tmp_path_factory):
    """How tasks end, by their names."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "only_here.py").write_text("def answer():\n    return 42\n")
    tasks = [
        Task("killed", "os:abort", {}),
        Task("root", "math:sqrt", {}),  # takes no keyword: fails
        Task("lost", "no_such_module:f", {}),
        Task("here", "only_here:answer", {}),
        Task("threads", "torch:get_num_threads", {}),
        Task("process", "os:getpid", {}),
        Task("other process", "os:getpid", {}),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("OMP_NUM_THREADS", raising=False)
        patch.syspath_prepend(folder)
        found = {end.task.name: end for end in ended(launcher_named(request.param), tasks)}
    assert found.keys() == {task.name for task in tasks}
    return found


def test_tasks_run_with_one_thread_each_and_return_what_they_made(ends):
    assert "TypeError" in ends["root"].error
    assert ends["root"].value is None
    assert ends["threads"].value == 1
    assert all(ends[name].error is None for name in ("threads", "process", "other process"))
    processes = {ends["process"].value, ends["other process"].value, os.getpid()}
    assert len(processes) == 3


def test_tasks_find_modules_where_this_process_finds_them(ends):
    assert (ends["here"].value, ends["here"].error) == (42, None)


@pytest.fixture(scope="module")
def looks(tmp_path_factory):
    """What six tasks of one module see, two at a time, and their logs."""
    folder = tmp_path_factory.mktemp("looks")
    (folder / "slow_module.py").write_text(LOOK)
    tasks = [Task(str(n), "slow_module:look", {}, folder / f"{n}.log") for n in range(6)]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        seen = {end.task.name: end.value for end in ended(launcher_named("local"), tasks)}
    return [seen[task.name] for task in tasks], [task.log.read_text() for task in tasks]


def test_modules_are_imported_once_for_all_local_tasks_and_chance_is_their_own(looks):
    seen, logs = looks
    (importer,) = {one[0] for one in seen}
    assert {one[1] for one in seen} == {importer}
    assert importer != os.getpid()
    assert len({one[3] for one in seen}) == len({one[4] for one in seen}) == 6
    assert logs == [""] * 6


@pytest.mark.skipif(sys.platform != "linux", reason="Linux numbers processes as they begin")
def test_tasks_begin_in_their_order_with_several_workers_too(looks):
    processes = [one[2] for one in looks[0]]
    assert processes == sorted(processes)


@pytest.mark.skipif(sys.platform != "linux", reason="counts threads as Linux shows them")
def test_modules_of_our_tasks_start_no_thread_that_a_fork_would_lose():
    modules = [function.partition(":")[0] for function in (runner.FUNCTION, tuner.WORK)]
    code = (
        f"import {', '.join(modules)}, os, torch._dynamo\n"
        "print(len(os.listdir('/proc/self/task')), torch.cuda.is_initialized())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "1 False\n", done.stderr


def test_a_module_that_cannot_be_imported_fails_its_own_task_alone(ends):
    assert "No module named 'no_such_module'" in ends["lost"].error
    assert ends["process"].error is None


def test_a_module_that_ends_the_process_that_imports_it_is_told(tmp_path, monkeypatch):
    (tmp_path / "exits.py").write_text("import sys\nprint('so it is')\nsys.exit(4)\n")
    monkeypatch.syspath_prepend(tmp_path)
    (end,) = ended(launcher_named("local"), [Task("exits", "exits:f", {})])
    assert end.error == "its process exited with 4\nso it is"


def test_ctrl_c_of_a_terminal_reaches_a_task_once_and_kills_nothing_else(tmp_path):
    """A terminal sends it to the whole group of processes."""
    (tmp_path / "patient.py").write_text(
        "import os, time\n"
        "def sit(noted):\n"
        "    try:\n"
        "        print(os.getpgid(0), file=(file := open(noted, 'w')), end='', flush=True)\n"
        "        time.sleep(60)\n"
        "    except KeyboardInterrupt:\n"
        "        time.sleep(0.5)\n"
        "        open(noted, 'a').write(' stopped')\n"
    )
    noted = tmp_path / "noted"
    code = (
        "from sb3_sparse.launch import Task, launcher_named\n"
        f"task = Task('t', 'patient:sit', {{'noted': {str(noted)!r}}})\n"
        "endings = launcher_named('local').run([task], 1)\n"
        "try:\n"
        "    list(endings)\n"
        "except KeyboardInterrupt:\n"
        "    endings.close()\n"
        "    print('closed')\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not (noted.exists() and noted.read_text()):
        time.sleep(0.1)
        assert parent.poll() is None
    assert int(noted.read_text()) == parent.pid
    os.killpg(parent.pid, signal.SIGINT)
    assert parent.communicate(timeout=30)[0] == "closed\n"
    assert noted.read_text() == f"{parent.pid} stopped"


def test_a_killed_process_takes_no_other_task_with_it(ends):
    assert ends["killed"].error
    assert ends["process"].error is None


def test_one_at_a_time_writes_to_the_log_and_a_crash_shows_its_last_lines(tmp_path):
    log = tmp_path / "logs" / "task.log"
    code = "import sys; print('first'); print('last', file=sys.stderr)"
    tasks = [
        Task("talks", "subprocess:call", {"args": [sys.executable, "-c", code]}, log),
        Task("exits", "os:_exit", {"status": 3}, log),
        Task("fails", "time:sleep", {}),
    ]
    talks, exits, fails = ended(launcher_named("local"), tasks, workers=1)
    assert [end.task for end in (talks, exits, fails)] == tasks
    assert talks.value == 0
    assert set(log.read_text().split()) == {"first", "last"}
    how, *lines = exits.error.splitlines()
    assert "exited with 3" in how
    assert set(lines) == {"first", "last"}


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
