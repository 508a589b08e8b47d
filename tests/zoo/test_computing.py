"""What a run's record says of how the run computes."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import NatureCNN
from support import make

import sb3_sparse
from sb3_sparse.engine.native import library
from sb3_sparse.errors import CorruptStateError
from sb3_sparse.networks import ImpalaCNN
from sb3_sparse.zoo.computing import (
    Computing,
    Session,
    computing_at,
    computing_in,
    gradient_steps_of,
)
from sb3_sparse.zoo.folder import RunFolder
from sb3_sparse.zoo.inspection import inspect_model
from sb3_sparse.zoo.record import Record
from sb3_sparse.zoo.spec import RunSpec
from sb3_sparse.zoo.training import resume, train

LARGE = {"net_arch": [200, 200], "batch_size": 16, "learning_starts": 50, "update_interval": 20}
QUICK = dict(eval_freq=200, eval_episodes=1)
NAMES = ["q_net.q_net.0", "q_net.q_net.2", "q_net.q_net.4"]
"""4-200-200-2: 40,000 connections in the middle, so one chain of layers that may be sparse."""


SESSION = dict(
    num_timesteps=0, instructions=None, torch_instructions="", threads=1, layers={},
)  # fmt: skip


class CtrlC(BaseCallback):
    """What a user does after 900 steps."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 900:
            signal.raise_signal(signal.SIGINT)
        return True


def run(method: str = "rigl", steps: int = 300, **hyperparams) -> RunSpec:
    return RunSpec(method=method, n_timesteps=steps, hyperparams={**LARGE, **hyperparams}, **QUICK)


def layers_of(folder: Path) -> dict[str, str]:
    return {layer["name"]: layer["compute"] for layer in RunFolder(folder).record()["layers"]}


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    return train(run(), tmp_path_factory.mktemp("logs")).folder


def test_the_record_says_what_was_asked_for_and_what_decides_rounding(trained):
    found = computing_in(RunFolder(trained).record())
    sparse = dict.fromkeys(NAMES, "sparse")
    capability = th.backends.cpu.get_cpu_capability()
    session = Session(0, library.in_use(), capability, th.get_num_threads(), sparse, "fused")
    assert found == Computing("auto", (session,))
    assert layers_of(trained) == sparse


def test_masks_that_are_asked_for_are_on_record(tmp_path):
    folder = train(run(compute="masked"), tmp_path).folder
    found = computing_in(RunFolder(folder).record())
    assert found.asked == "masked"
    assert found.sittings[0].layers[NAMES[1]] == layers_of(folder)[NAMES[1]] == "masked"


def test_pruning_changes_how_layers_compute_and_the_record_has_both(tmp_path):
    pruned = run("prune", 600, update_interval=5)
    folder = train(pruned, tmp_path).folder
    (session,) = computing_in(RunFolder(folder).record()).sittings
    assert session.layers == dict.fromkeys(NAMES, "dense")
    assert layers_of(folder) == dict.fromkeys(NAMES, "sparse")
    told = str(inspect_model(folder))
    assert "Trained from step 0: 0 of 3 layers in sparse storage" in told


def test_a_resumed_run_has_one_more_session(tmp_path):
    pruned = run("prune", 1000, update_interval=5)
    stopped = train(pruned, tmp_path, [CtrlC()])
    steps = RunFolder(stopped.folder).record()["num_timesteps"]
    resume(stopped.folder)
    first, second = computing_in(RunFolder(stopped.folder).record()).sittings
    assert (first.num_timesteps, second.num_timesteps) == (0, steps)
    assert first.layers == dict.fromkeys(NAMES, "dense")
    assert second.layers == dict.fromkeys(NAMES, "sparse")  # before its first gradient step


def test_sessions_that_came_to_nothing_are_forgotten(trained):
    model = train(run(), trained.parent.parent).model
    record = dict(RunFolder(trained).record())
    for steps in (200, 400, 200):
        model.num_timesteps = steps
        record["computing"] = computing_at(model, Record(record))
    assert [one["num_timesteps"] for one in record["computing"]["sittings"]] == [0, 200]


def test_inspect_tells_what_the_record_says_not_what_would_be_chosen_here(
    trained, tmp_path, monkeypatch
):
    monkeypatch.setattr("sb3_sparse.zoo.inspection.choose", lambda *_: [])
    for path in (trained, trained / "best_model.zip"):
        found = inspect_model(path)
        assert [layer.compute for layer in found.report.layers] == ["sparse"] * 3
        assert "The run asked for compute='auto'." in str(found)
        assert f"3 of 3 layers in sparse storage, {library.in_use()} kernels" in str(found)
        assert str(found).endswith(", 1 thread, gradient steps fused.")
    shutil.copy(trained / "best_model.zip", tmp_path)
    best = inspect_model(tmp_path / "best_model.zip")
    assert best.computing is None
    assert [layer.compute for layer in best.report.layers] == ["dense", "masked", "dense"]


@pytest.mark.parametrize("extractor", [NatureCNN, ImpalaCNN])
def test_inspect_tells_what_auto_chooses_for_images(extractor, tmp_path):
    kwargs = dict(features_extractor_class=extractor, compute="auto", net_arch=[], sparsity=0.8)
    model = make("DQN", "TinyImages-v0", policy_kwargs=kwargs)
    model.save(tmp_path / "model")
    chosen = {layer.name: layer.compute for layer in model.policy.sparsity_report().layers}
    assert chosen["q_net.features_extractor.cnn.0"] == "sparse"
    found = inspect_model(tmp_path / "model.zip").report.layers
    assert {layer.name: layer.compute for layer in found} == chosen


@pytest.fixture
def record(trained):
    """The record's file, which is put back in the end."""
    path = trained / "sparsity.json"
    before = path.read_text()
    yield json.loads(before)
    path.write_text(before)


def test_gradient_steps_of_older_records_were_sb3s(trained, record):
    del record["computing"]["sittings"][0]["gradient_steps"]
    (trained / "sparsity.json").write_text(json.dumps(record))
    assert str(inspect_model(trained)).endswith(", gradient steps SB3's own.")


def test_records_of_older_versions_are_read(trained, record):
    del record["computing"]
    for layer in record["layers"]:
        del layer["compute"]
    (trained / "sparsity.json").write_text(json.dumps(record))
    found = inspect_model(trained)
    assert found.computing is None
    assert "compute='auto': 3 of 3 layers in sparse storage here" in str(found)


def test_records_that_say_non_zeros_are_read_as_sparse(trained, record):
    now = inspect_model(trained)
    former = json.dumps(record).replace('"sparse"', '"non-zeros"')
    assert former.count('"non-zeros"') == 2 * len(NAMES)  # in layers, and in the one session
    (trained / "sparsity.json").write_text(former)
    assert inspect_model(trained) == now


@pytest.mark.parametrize(
    "damage",
    [
        {"computing": 3},
        {"computing": {"asked": "auto"}},
        {"computing": {"asked": "auto", "sittings": [{"num_timesteps": 0}]}},
        {"layers": [{"name": "q_net.q_net.0", "nnz": 80, "compute": "quickly"}]},
        {"layers": 3},
        {"computing": {"asked": "auto", "sittings": [{**SESSION, "gradient_steps": 3}]}},
    ],
)
def test_a_damaged_record_is_named(trained, record, damage):
    RunFolder(trained).write(**damage)
    with pytest.raises(CorruptStateError, match=r"sparsity\.json"):
        inspect_model(trained)


@pytest.mark.parametrize(
    ("make_model", "how"),
    [
        (lambda: make(sb3_sparse.SAC), "fused"),
        (lambda: make(sb3_sparse.SAC, use_sde=True), "SB3's own: gSDE"),
        (lambda: make("CrossQ"), "SB3's own: CrossQ has no others"),
    ],
)
def test_how_gradient_steps_run_is_told_before_they_do(make_model, how):
    assert gradient_steps_of(make_model()) == how
