"""Small studies, and a launcher that runs them in this process."""

from __future__ import annotations

from collections.abc import Sequence

import yaml

from sb3_sparse.launch.base import Launcher, Task, TaskResult
from sb3_sparse.studies import Study, run_study

QUICK = {
    "n_timesteps": 300,
    "eval_freq": 100,
    "eval_episodes": 1,
    "hyperparams": {"learning_starts": 100, "net_arch": [8], "batch_size": 16},
}
RUNS = [{"method": "dense"}, {"method": "static", "sparsity": 0.5}]


class Here(Launcher):
    """Runs the tasks in this process, one after another; fails those named, so many times."""

    def __init__(self, fails=None):
        self.fails = fails or {}
        self.called = []

    def run(self, tasks: Sequence[Task], workers: int):
        for task in tasks:
            self.called.append(task.name)
            if self.fails.get(task.name, 0) > 0:
                self.fails[task.name] -= 1
                yield TaskResult(task, error="Traceback: it broke")
            else:
                yield TaskResult(task, value=task())


def study(tmp_path, name="mine", **changed):
    path = tmp_path / f"{name}.yml"
    content = {
        "title": "T",
        "figures": ["iqm"],
        "common": {"algo": "dqn", "env_id": "CartPole-v1"},
        "runs": RUNS,
        "scales": {"smoke": QUICK},
    }
    path.write_text(yaml.safe_dump({**content, **changed}))
    return Study.read(str(path), "smoke")


def finish(what, store, launcher=None, archive=None):
    *_, last = run_study(what, store, launcher or Here(), 1, archive)
    return last
