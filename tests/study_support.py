"""Small studies, a launcher that runs them in this process, and made-up lines of archives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml

from sb3_sparse.launch.base import Launcher, Task, TaskResult
from sb3_sparse.studies import Study, run_study
from sb3_sparse.studies.cell import Cell
from sb3_sparse.zoo.archive import Archived
from sb3_sparse.zoo.record import Record

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


def archived(cell: Cell, spent: float | None, score: float = 100.0, **changed: Any) -> Archived:
    """A made-up line of an archive.

    :param spent: the processor's seconds; None: as in records of older versions
    :param score: return of its only evaluation
    :param changed: other entries of the record
    """
    run, settings = cell.run, cell.settings
    kwargs = settings.policy_kwargs
    layer = {"network": "q_net", "name": "q_net.0", "shape": [10, 10], "nnz": 100, "flops": 1}
    record = {
        "status": "finished",
        "run": run.as_dict(),
        "settings": settings.as_dict(),
        "method": run.name_of(settings),
        "num_timesteps": settings["n_timesteps"],
        "evaluation": run.evaluation(),
        "total": {
            "sparsity": kwargs["sparsity"], "nnz": 100, "wanted_nnz": 100, "parameters": 110,
            "flops": 200, "dense_flops": 200,
        },
        "layers": [{**layer, "dense_flops": 1, "parameters": 110}],
        **({} if spent is None else {"seconds": {"wall": 2 * spent, "processor": spent}}),
        **changed,
    }  # fmt: skip
    one = np.array([[1.0]])
    return Archived(cell.address, Record(record), one[0], score * one, one)
