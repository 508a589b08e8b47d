"""What a run's record says of the seconds that it trained."""

from __future__ import annotations

import json

import pytest
from stable_baselines3.common.callbacks import BaseCallback
from zoo.test_train import DQN_RUN, Stop

import sb3_sparse.zoo.clock as clock
from sb3_sparse.errors import CorruptStateError
from sb3_sparse.zoo.clock import Seconds, seconds_in
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.record import Record
from sb3_sparse.zoo.training import resume, train
from sb3_sparse.zoo.watch import Watch


class Tick(BaseCallback):
    """A step of training takes one second, in which two processors compute."""

    def __init__(self, time):
        super().__init__()
        self.time = time

    def _on_step(self) -> bool:
        self.time.append(Seconds(1, 2))
        return True


class SlowEvaluations(Watch):
    def __init__(self, time):
        super().__init__()
        self.time = time

    def evaluated(self, step, mean, std, best):
        self.time.append(Seconds(1000, 1000))


@pytest.fixture
def time(monkeypatch):
    """Pieces of time that have passed."""
    passed = [Seconds(77, 5)]
    monkeypatch.setattr(clock, "now", lambda: sum(passed, Seconds()))
    return passed


def recorded(folder):
    return seconds_in(RunFolder(folder).record())


def test_steps_count_and_evaluations_do_not(time, tmp_path):
    outcome = train(DQN_RUN, tmp_path, [Tick(time)], watch=SlowEvaluations(time))
    assert recorded(outcome.folder) == Seconds(500, 1000)


def test_a_stopped_run_adds_up(time, tmp_path):
    def callbacks():
        return [Tick(time), Stop(250)]

    folder = train(DQN_RUN, tmp_path, callbacks(), watch=SlowEvaluations(time)).folder
    stopped = RunFolder(folder).record().num_timesteps
    assert recorded(folder) == Seconds(stopped, 2 * stopped)
    time.append(Seconds(5000, 5000))  # the time between two processes
    resume(folder, [Tick(time)], SlowEvaluations(time))
    assert recorded(folder) == Seconds(500, 1000)


def test_what_a_kill_cost_counts_once(time, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train(DQN_RUN, tmp_path, [Tick(time), Stop(250, times=2)])
    folder = tmp_path / "dqn" / "CartPole-v1_1"
    assert recorded(folder) == Seconds(200, 400)  # of the last checkpoint
    resume(folder, [Tick(time)])
    assert recorded(folder) == Seconds(500, 1000)


def test_a_run_that_an_older_version_began_has_no_total(time, tmp_path):
    folder = train(DQN_RUN, tmp_path, [Tick(time), Stop(250)]).folder
    path = folder / "sparsity.json"
    record = json.loads(path.read_text())
    del record["seconds"]
    path.write_text(json.dumps(record))
    resume(folder, [Tick(time)])
    assert recorded(folder) is None


@pytest.mark.parametrize(
    "seconds", [3, {}, {"wall": -1, "processor": 1}, {"wall": "1", "processor": 1}, {"wal": 1}]
)
def test_a_damaged_entry_is_named(seconds):
    with pytest.raises(CorruptStateError, match="sparsity.json"):
        seconds_in(Record({"status": "finished", "seconds": seconds}))


def test_a_real_run_takes_time(tmp_path):
    found = recorded(train(DQN_RUN, tmp_path).folder)
    assert found.wall > 0
    assert found.processor > 0
