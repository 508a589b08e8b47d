"""Checkpoints: read whole before anything is replaced; and locks, which a look leaves alone."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.errors import ConfigError, RunBusy, SparsityError
from sb3_sparse.zoo import checkpoint
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import resume, train

RUN = RunSpec(
    n_timesteps=800,
    eval_freq=200,
    eval_episodes=2,
    hyperparams={"net_arch": [8], "batch_size": 16, "learning_starts": 50, "normalize": True},
)


class Stop(BaseCallback):
    """What a user's Ctrl-C does after 500 steps."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 500:
            signal.raise_signal(signal.SIGINT)
        return True


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Folder of a run that was stopped after 500 steps."""
    return train(RUN, tmp_path_factory.mktemp("logs"), [Stop()]).folder


class Killed(BaseCallback):
    """What a kill does after 30 steps; and which checkpoints there were until then."""

    def __init__(self, root: Path) -> None:
        super().__init__()
        self.root = root
        self.seen: set[int | None] = set()

    def _on_step(self) -> bool:
        (folder,) = self.root.glob("dqn/*")
        found = RunFolder(folder).last_checkpoint()
        self.seen.add(None if found is None else int(found.name))
        if self.num_timesteps == 30:
            raise OSError("killed")
        return True


@pytest.mark.parametrize(("seconds", "saved"), [(0.0, 29), (120.0, None)])
def test_a_kill_before_the_first_evaluation_costs_two_minutes_at_most(
    tmp_path, monkeypatch, seconds, saved
):
    killed = Killed(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "SECONDS", seconds)
        with pytest.raises(OSError, match="killed"):
            train(RUN, tmp_path, [killed])
    (folder,) = (tmp_path / "dqn").iterdir()
    found = RunFolder(folder).last_checkpoint()
    assert (None if found is None else int(found.name)) == saved
    assert len(killed.seen) == (30 if saved else 1)
    assert resume(folder).finished
    evaluations = np.load(folder / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [200, 400, 600, 800]


@pytest.fixture
def folder(stopped, tmp_path):
    """A copy of it."""
    copy = tmp_path / "dqn" / stopped.name
    shutil.copytree(stopped, copy)
    return copy


def content(folder: Path) -> dict[Path, bytes]:
    """Every file but the one that notes where the run lies."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "args.yml")
    return {path: path.read_bytes() for path in files}


@pytest.mark.parametrize(
    "name",
    [
        "CartPole-v1.zip",
        "CartPole-v1/vecnormalize.pkl",
        "replay_buffer/rest.pkl",
        "replay_buffer/0.npz",
        "best_model.zip",
        "evaluation.json",
        "evaluations.npz",
    ],
)
def test_a_damaged_file_of_a_checkpoint_costs_nothing_of_the_run(name, folder):
    damaged = RunFolder(folder).last_checkpoint() / name
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[: len(whole) // 2])
    (folder / "best_model.zip").write_bytes(b"better than the checkpoint's")
    before = content(folder)
    assert {"0.monitor.csv", "evaluations.npz"} <= {path.name for path in before}
    with pytest.raises(SparsityError, match="is damaged"):
        resume(folder)
    assert content(folder) == before
    damaged.write_bytes(whole)
    assert resume(folder).finished


def test_a_run_is_not_trained_over_another(folder):
    before = RunFolder(folder).record()
    with pytest.raises(ConfigError, match="there is already a run in .*; resume it with"):
        train(RUN, folder=folder)
    assert RunFolder(folder).record() == before
    assert RunFolder(folder).last_checkpoint().name == "500"


def test_seeing_whether_a_run_is_locked_writes_nothing_and_stops_nobody(tmp_path):
    assert not RunFolder(tmp_path).is_locked()
    assert list(tmp_path.iterdir()) == []
    with RunFolder(tmp_path).locked():
        assert RunFolder(tmp_path).is_locked()
        with (
            pytest.raises(RunBusy, match="another process is at work"),
            RunFolder(tmp_path).locked(),
        ):
            pass
    (tmp_path / ".lock").touch()  # of a process that was killed
    looking = Event()

    def look():
        while not looking.is_set():
            RunFolder(tmp_path).is_locked()

    watcher = Thread(target=look)
    watcher.start()
    for _ in range(20):
        with RunFolder(tmp_path).locked():
            pass
    looking.set()
    watcher.join()
