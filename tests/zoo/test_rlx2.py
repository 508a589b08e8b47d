"""RLx2 as a run: trained, interrupted, resumed, reported, tuned, and a study."""

from __future__ import annotations

import signal
from itertools import product

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sparse.buffers import DynamicReplayBuffer
from sb3_sparse.report import read_runs
from sb3_sparse.studies import Study
from sb3_sparse.tuning import Space
from sb3_sparse.tuning.backend import optuna
from sb3_sparse.tuning.spaces import check_space
from sb3_sparse.zoo import RunFolder, RunSpec, resume, train
from sb3_sparse.zoo.settings import Settings

SMALL = {
    "learning_starts": 30,
    "buffer_size": 500,
    "net_arch": [32],
    "update_interval": 10,
    "check_interval": 10,
    "min_buffer_size": 60,
    "oldest": 10,
    "distance_threshold": 0.0,
}


def small(**more):
    run = {"hyperparams": SMALL, "n_timesteps": 200, "eval_freq": 100, "eval_episodes": 1, **more}
    return RunSpec("sac", "Pendulum-v1", method="rlx2", **run)


class Interrupt(BaseCallback):
    """Sends Ctrl-C after some environment steps."""

    def _on_step(self):
        if self.num_timesteps == 130:
            signal.raise_signal(signal.SIGINT)
        return True


def test_a_run_is_trained_interrupted_resumed_and_reported(tmp_path):
    stopped = train(small(), tmp_path, callbacks=[Interrupt()])
    assert not stopped.finished
    before = stopped.model.replay_buffer
    assert isinstance(before, DynamicReplayBuffer)
    assert before.n_steps == 3
    assert before.forgotten > 0
    record = RunFolder(stopped.folder).record()
    assert record["method"] == "rlx2"
    outcome = resume(stopped.folder)
    assert outcome.finished
    after = outcome.model.replay_buffer
    assert isinstance(after, DynamicReplayBuffer)
    assert after.pos == 200
    assert after.size() < 130
    assert (after.action_means[:130] == before.action_means[:130]).all()
    assert np.abs(after.action_means[130:200]).any()
    assert outcome.model.why_not_fused() is None
    runs, left_out = read_runs([stopped.folder])
    assert [(run.label, run.trained) for run in runs] == [("rlx2", True)]
    assert not left_out


def test_a_search_varies_its_arguments():
    space = Space("mine", {"distance_threshold": optuna.distributions.FloatDistribution(0.1, 0.5)})
    run = RunSpec("sac", "Pendulum-v1", method="rlx2")
    check_space(space, run)


def test_an_argument_is_overridden_wherever_the_callback_is_named():
    callbacks = ["sb3_sparse.ResetCallback", "sb3_sparse.callbacks.RobustValueCallback"]
    settings = Settings({"policy": "SparsePolicy", "callback": callbacks, "policy_kwargs": {}})
    assert settings.changed({"multi_step": 5}, SAC)["callback"] == [
        callbacks[0],
        {callbacks[1]: {"multi_step": 5}},
    ]
    mine = Settings({"policy": "SparsePolicy", "callback": "my.sb3_sparse.RobustValueCallback"})
    assert mine.robust_value is None


@pytest.mark.parametrize(
    ("scale", "algo"),
    [
        *product(["smoke", "small", "medium", "paper"], ["sac"]),
        *product(["medium", "paper"], ["td3"]),
    ],
)
def test_the_arms_of_the_study_differ_in_what_they_name_alone(scale, algo):
    study = Study.read("robust_value", scale)
    by_name = {}
    for cell in study.cells:
        run = cell.run
        same = run.seed == 0 and run.algo == algo and run.env_id == study.cells[0].run.env_id
        if same and 0.9 in (run.sparsity, run.match_params, 0.9 if run.method == "dense" else 0):
            threshold = run.hyperparams.get("distance_threshold")
            by_name[run.method, run.match_params, threshold] = run.settings()
    dense, equal = by_name.pop(("dense", None, None)), by_name.pop(("dense", 0.9, None))
    rigl, never = by_name["rigl", None, None], by_name["rlx2", None, 2.0]
    rlx2 = by_name["rlx2", None, 0.2]
    plain = ("callback", "policy_kwargs")
    others = [{k: v for k, v in one.items() if k not in plain} for one in (dense, equal, rigl)]
    for one in others:
        assert {k: v for k, v in rlx2.items() if k in one and k not in plain} == {
            k: v for k, v in one.items() if k in rlx2
        }
    assert rigl.callback == rlx2.callback == never.callback
    assert {**rlx2.robust_value, "distance_threshold": 2.0} == never.robust_value
    assert rigl.robust_value is None
    kwargs = {**rlx2.policy_kwargs}
    assert kwargs.pop("distribution") == "er"  # that is erk, in a network without convolutions
    assert {k: v for k, v in rigl.policy_kwargs.items() if k != "distribution"} == kwargs
